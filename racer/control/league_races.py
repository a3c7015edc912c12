"""The job that drives a race of a league: an evaluation of the checkpoint that a model was made of. No I/O."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from orchestrator.spec.evaluations import evaluation_document
from orchestrator.spec.model import Spec, validate
from racer.store.leagues import League


def race_job(league: League, model: str, facts: Mapping[str, Any], queue: str) -> Spec:
    """The race of a model by the rules of a league, on a node like those of its training. Raises SpecError.

    Args:
        league: Its rules, tracks, seed and car.
        model: ``NAME@VERSION``.
        facts: Its facts in the registry.
        queue: In which the job waits.
    """
    section = {"checkpoint": facts["iteration"], **league.section()}
    name = f"race-{league.name}-{model}"[:100].replace(".", "-").replace("@", "-")
    document = evaluation_document(str(facts["run"]), facts.get("spec") or {}, section, name, "race")
    return validate({**document, "queue": queue}, f"race of {model}")
