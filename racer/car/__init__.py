"""The car: its motion, sensors, resets and traces, and the tasks that train it."""
