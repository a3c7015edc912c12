"""Declarations: what the author of a task writes."""
