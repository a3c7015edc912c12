"""Compiled kernels before the first step: found by a dry pass, compiled in parallel, or taken from an installed package."""
