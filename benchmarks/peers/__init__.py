"""Muster compared with mjlab, Isaac Lab and rsl_rl: wall time of the same training on the same machine. ``README.md`` explains how to
repeat it."""
