"""The jobs of a seed, as their users know them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from random import Random
from typing import Any

from orchestrator.persistence.batch_models import Job
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.model import validate

SUBMITTING = 1200.0
"""Seconds during which jobs are submitted and faults happen."""


@dataclass
class SimulatedJob:
    """What a user wants, knows and has."""

    name: str
    id: str
    submitted_at: float
    """When it is submitted [s]."""
    stopped_at: float | None
    """When its user asks for its end [s]."""
    nodes: int
    work: float
    """Seconds that its main node needs in all."""
    code: int
    """Exit code once the work is done; 1 by a fault, which every attempt meets there."""
    breaks: list[float]
    """Seconds after which an attempt fails by itself, by attempt."""
    attempts: int
    timeout: int | None
    urgent: bool
    """It is in a queue that preempts."""
    pulling: float
    """Seconds for which its image is pulled before it can be launched."""
    acknowledged: bool = False
    stop_requested: bool = False
    done: float = 0.0
    """Seconds of work that its checkpoints hold."""
    main_ends: list[tuple[int, int, bool]] = field(default_factory=list)
    """Attempt and exit code of each main node that ended by itself, and whether it had been asked to end by then."""
    faults: set[int] = field(default_factory=set)
    """Attempts with the fault in their main node's outcome."""
    final: str = ""
    """The state that was shown once, and must stay."""

    def row(self) -> Job:
        """The job as a submission adds it to the database."""
        return Job(
            id=self.id,
            name=self.name,
            queue="urgent" if self.urgent else "default",
            definition="job:1",
            kind="multinode",
            request={},
            node_properties=_definition(self.nodes),
            run=self.name,
            status="SUBMITTED",
            attempts_allowed=self.attempts,
            timeout=self.timeout,
        )


def draw_job(seed: int, index: int) -> SimulatedJob:
    """Job number ``index`` of a seed: the same whichever others there are."""
    rng = Random(f"{seed} job {index}")
    attempts = rng.choice((1, 2, 3))
    return SimulatedJob(
        name=f"j{index}",
        id=f"{seed}-j{index}",
        submitted_at=rng.uniform(0, SUBMITTING),
        stopped_at=rng.uniform(0, 2 * SUBMITTING) if rng.random() < 0.1 else None,
        nodes=rng.choice((1, 1, 2, 3)),
        work=rng.uniform(5, 300),
        code=0 if rng.random() < 0.8 else rng.choice((1, 2)),
        breaks=[rng.uniform(1, 200) if rng.random() < 0.2 else 1e9 for _ in range(attempts + 20)],
        attempts=attempts,
        timeout=rng.choice((60, 300)) if rng.random() < 0.1 else None,
        urgent=rng.random() < 0.15,
        pulling=rng.uniform(5, 120) if rng.random() < 0.2 else 0.0,
    )


@cache
def _definition(nodes: int) -> dict[str, Any]:
    document = {
        "name": "job",
        "nodes": nodes,
        "resources": {"cpus": 1, "memory": "16MiB"},
        "command": ["true"],
        "preemptible": True,
    }
    properties: dict[str, Any] = compile_definition(validate(document, "job"), "/")["nodeProperties"]
    return properties
