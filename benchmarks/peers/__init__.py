"""Muster beside mjlab, Isaac Lab and rsl_rl: the same training by the clock, on the same machine. ``README.md`` says how to repeat it."""
