"""The racer: tracks, a car that drives on them, reward functions, races and leagues; a plug-in of Muster."""
