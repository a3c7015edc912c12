"""The racer: cars that learn to drive round a track."""
