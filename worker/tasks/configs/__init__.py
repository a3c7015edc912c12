"""The configurations of the built-in tasks, separate from the tasks: the controller checks jobs with them, without torch."""
