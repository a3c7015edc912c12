"""Code shared by several engines."""
