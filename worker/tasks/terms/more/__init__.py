"""Terms that no shipped task uses. ``terms.NAME`` finds them, too, and imports them then."""

from __future__ import annotations

from importlib import import_module

from worker.tasks.terms import terms_of
from worker.tasks.terms.more.frame_sampling import AdaptiveSampling as AdaptiveSampling
from worker.tasks.terms.more.motion import Motion as Motion
from worker.tasks.terms.more.motion import MotionArrays as MotionArrays

GROUPS = (
    *("joints", "root", "bodies", "actions", "commands", "events", "episode", "locomotion"),
    *("contacts", "sensing", "ground", "manipulation", "tracking", "following"),
)
"""Modules of terms, in the order of the documentation."""

for _group in GROUPS:
    globals().update(terms_of(import_module(f"{__name__}.{_group}")))
