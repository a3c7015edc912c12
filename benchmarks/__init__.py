"""Benchmarks; each module prints and writes a table."""
