"""The racer: tracks, and what a car on one is told about it."""
