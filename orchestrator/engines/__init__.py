"""Engines: what starts gangs on machines."""
