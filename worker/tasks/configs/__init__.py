"""The configurations of the built-in tasks, apart from the tasks themselves: the controller checks jobs with them, without torch."""
