"""Comparison of runs: groups, curves, and differences of weights."""
