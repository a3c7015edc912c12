"""The HTTP interface: AWS Batch's operations under ``/v1/``, our own under ``/api/``."""
