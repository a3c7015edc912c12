"""The reconcile loop and its threads."""
