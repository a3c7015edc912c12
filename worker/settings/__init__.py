"""Settings of algorithms and tasks, which the controller reads too, and what every rank needs from its first line on. Imports no torch."""
