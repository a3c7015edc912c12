"""CloudWatch Logs over the logs in the store."""
