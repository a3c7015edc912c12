"""What is measured; each module prints and writes a table."""
