"""Compilation: from a declaration and its robots to kernels, tables and the policy contract."""
