"""AWS Batch's operations, in AWS's shapes."""
