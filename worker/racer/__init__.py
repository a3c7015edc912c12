"""The racer: tracks, what a car on one is told about it, and reward functions."""
