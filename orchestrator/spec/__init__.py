"""The job YAML: its model, its file with lines of errors, and what it compiles to."""
