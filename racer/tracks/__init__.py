"""Tracks: their geometry, presets, files and pictures."""
