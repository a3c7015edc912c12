"""The job YAML: its model, its file with lines of errors, and the job definition made of it."""
