"""Changes of a task since a policy's training that a job accepts. Imported without torch and without the simulation."""

from __future__ import annotations

from contextvars import ContextVar

CHANGED_ROBOTS = ContextVar("accept_changed_robot", default=False)
"""Whether a robot that can't be held as its file says is loaded all the same, as a policy's training had it: the key
``accept_changed_robot`` of the job's section."""
