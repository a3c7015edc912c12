"""Mutation: whether the tests notice small faults in a module (``make mutants``)."""
