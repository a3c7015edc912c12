"""The volume: layout, atomic commits, checkpoints, logs, metrics, outcomes and models."""
