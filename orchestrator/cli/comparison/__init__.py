"""Runs side by side: their groups, their curves, how weights differ."""
