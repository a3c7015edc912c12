"""The native API, for everything beyond AWS Batch: ``/api/``."""
