"""The job that drives a race of a league: an evaluation of the checkpoint that a model was made of. No I/O."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from orchestrator.evaluating import evaluation_document
from orchestrator.spec import Spec, validate
from shared_store.leagues import League


def is_racer(task: object) -> bool:
    """Whether a league takes models of this task: the installed ones of the racer. A class of the user's own could be any car."""
    return isinstance(task, str) and task.startswith("Racer") and ":" not in task


def race_job(league: League, model: str, facts: Mapping[str, Any], queue: str) -> Spec:
    """The race of a model by the rules of a league, on a node like those of its training. Raises SpecError.

    Args:
        league: Its rules, tracks, seed and car.
        model: ``NAME@VERSION``.
        facts: What the registry says of it.
        queue: In which the job waits.
    """
    rules = asdict(league.rules)
    del rules["ranking"]
    section = {
        "checkpoint": facts["iteration"],
        "seed": league.seed,
        "track": list(league.track),
        "config": dict(league.car),
        **rules,
    }
    name = f"race-{league.name}-{model}".replace(".", "-").replace("@", "-")[:100]
    document = evaluation_document(str(facts["run"]), facts.get("spec") or {}, {}, name)
    document["race"] = {**document.pop("evaluate"), **section}
    return validate({**document, "queue": queue}, f"race of {model}")
