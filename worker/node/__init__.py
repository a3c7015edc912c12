"""The processes of a node: supervisor, ranks, bus, and the starts of nodes on Slurm and AWS. Imports no torch."""
