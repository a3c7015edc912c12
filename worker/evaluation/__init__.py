"""Evaluation: whole episodes of a policy, what is recorded of each, and how sure one may be of the figures."""
