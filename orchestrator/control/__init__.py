"""The reconcile loop and what stands beside it."""
