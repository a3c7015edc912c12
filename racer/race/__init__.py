"""A race: a checkpoint drives laps from the start line, and each lap's times and traces are kept."""
