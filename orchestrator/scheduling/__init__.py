"""The scheduler: pure decisions over a snapshot. Order, fair share, gang admission, backfill, preemption, reasons for waiting."""

from orchestrator.scheduling.decide import Cancel, Decisions, Preempt, Start, decide
from orchestrator.scheduling.fit import Fit, fit
from orchestrator.scheduling.order import decayed
from orchestrator.scheduling.placement import never_fits, place
from orchestrator.scheduling.reasons import Board
from orchestrator.scheduling.snapshot import (
    FairShare,
    Leading,
    NodeShape,
    Pool,
    Queue,
    Running,
    Shape,
    Snapshot,
    TimeLimit,
    Waiting,
)

__all__ = [
    "Board",
    "Cancel",
    "Decisions",
    "FairShare",
    "Fit",
    "Leading",
    "NodeShape",
    "Pool",
    "Preempt",
    "Queue",
    "Running",
    "Shape",
    "Snapshot",
    "Start",
    "TimeLimit",
    "Waiting",
    "decayed",
    "decide",
    "fit",
    "never_fits",
    "place",
]
