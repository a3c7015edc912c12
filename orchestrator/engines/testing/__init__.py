"""For whoever writes an engine: tests that every engine passes, and an engine of which a test decides everything."""
