"""Processes of a node: their start, their marks, their groups and their reliable end. Linux only."""
