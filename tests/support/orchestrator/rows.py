"""Rows of the database, with what a test does not care about filled in."""

from __future__ import annotations

from typing import Any

from orchestrator.persistence.batch_models import Job
from tests.support.definitions import nodes_of

NODES = nodes_of({"command": ["true"]}, 2)


def job(job_id: str, **facts: Any) -> Job:
    values = {"id": job_id, "name": job_id, "queue": "default", "definition": "arn:d:1", "request": {}, "run": job_id}
    return Job(**{**values, "node_properties": NODES, **facts})
