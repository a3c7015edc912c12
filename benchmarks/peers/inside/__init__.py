"""What runs inside each peer's own environment: it imports nothing of Muster where that is not installed."""
