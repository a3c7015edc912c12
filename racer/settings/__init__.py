"""Settings of the racer: its tasks' configuration, action spaces, and DeepRacer's hyperparameters; imports no torch."""
