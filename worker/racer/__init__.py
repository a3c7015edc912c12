"""The racer: tracks, what a car on one observes, and reward functions."""
