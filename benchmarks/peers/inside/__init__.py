"""Programs for each peer's own environment; in those without Muster they import nothing of it."""
