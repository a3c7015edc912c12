"""The model registry: the lineage and evaluations of each policy, and whether it is unchanged since its registration."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from fastapi import Query, Request, Response

from orchestrator.api.native.model_routes import list_models, read_model
from orchestrator.api.native.run_routes import run_detail
from orchestrator.console.lineage import drawing
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.console.run_parts import evaluations_of
from orchestrator.console.submit_fields import written
from orchestrator.domain.errors import ClientError
from shared_store.volume.files import DamagedFile

router = page_router(stored=True)

_MOST_VERSIONS = 30
"""Number of a model's newest versions in its graph, beside the one on the page."""


@router.get("/models")
def models(request: Request) -> Response:
    """The newest version of each model."""
    return render(request, "models.html", models=[_row(each) for each in list_models(request)])


@router.get("/models/{name}")
def model(
    request: Request, name: str, version: int | None = Query(default=None, ge=1), verify: bool = Query(default=False)
) -> Response:
    """A version of a model; with ``verify`` every file of it is read."""
    found = read_model(request, name, version, verify)
    chosen = found["version"]
    shown = sorted({*found["versions"][-_MOST_VERSIONS:], chosen})
    versions = [found if each == chosen else _version(request, name, each) for each in shown]
    facts = {
        "Task": found.get("task"),
        "Algorithm": found.get("algorithm"),
        "Run": f"{found.get('run')}@{found.get('iteration')}",
        "Score": _number(found.get("score")),
        "Return of the bundle": _number(((found.get("judged") or {}).get("bundle") or {}).get("mean_return")),
        "Robot": found.get("changed_robot"),
        "Made with": ", ".join(f"{key} {value}" for key, value in (found.get("made_with") or {}).items()),
        "Registered by": found.get("registered_by"),
        "Queue": found.get("queue"),
        "Weights (SHA-256)": found.get("weights"),
        "Directory": found.get("path"),
    }
    return render(
        request,
        "model.html",
        model=found,
        facts=facts.items(),
        graph=drawing([each for each in versions if each], chosen, partial(_parent, request)),
        evaluations=evaluations_of(found.get("evaluations") or [], ""),
        spec=written(found["spec"]) if isinstance(found.get("spec"), dict) else "",
        contract=_contract(found.get("contract")).items(),
    )


def _version(request: Request, name: str, version: int) -> Mapping[str, Any] | None:
    """Another version of the model; None where the caller may not see it, or it is damaged."""
    try:
        found: Mapping[str, Any] = read_model(request, name, version, False)
        return found if found.get("run") else None
    except (ClientError, DamagedFile):
        return None


def _parent(request: Request, run: str) -> Mapping[str, Any] | None:
    """The run and checkpoint from which a run was cloned; None without one, or where the caller may not see it."""
    try:
        parent = run_detail(request, run).get("parent")
    except (ClientError, DamagedFile, OSError):
        return None
    return parent if isinstance(parent, Mapping) else None


def _row(model: Mapping[str, Any]) -> dict[str, Any]:
    """A model of the list; one that is damaged has only its name, version and problem."""
    own = [each for each in model.get("evaluations") or [] if not each.get("config")]
    best = max(own, key=lambda each: each["episodes"], default=None)
    return {
        **{
            key: model.get(key) or ""
            for key in ("name", "version", "task", "run", "iteration", "registered", "problem")
        },
        "return": _number(best["mean_return"] if best else model.get("score")),
    }


def _contract(contract: Any) -> dict[str, str]:
    """The policy's inputs and outputs, in a few words."""
    if not isinstance(contract, Mapping):
        return {}
    return {
        "Control rate": f"{contract.get('control_hz'):g} Hz",
        **{
            f"Observations: {group['name']}": _named(group.get("terms")) or " × ".join(map(str, group["shape"]))
            for group in contract.get("groups") or ()
        },
        "Actions": ", ".join(map(str, contract.get("action_names") or ())),
        "Commands": _named(contract.get("commands")),
        "Recurrent state": _named(contract.get("states")),
    }


def _named(parts: Any) -> str:
    return ", ".join(str(each["name"]) for each in parts or ())


def _number(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, int | float) else ""
