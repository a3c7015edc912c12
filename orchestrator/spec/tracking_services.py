"""The tracking services of a job, its YAML's section ``track``: those to which a training's metrics are sent as well."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from orchestrator.spec.values import Section
from shared_store.contract.error_text import nearest, shown

SERVICES = ("wandb", "mlflow")

CREDENTIALS = (
    "WANDB_API_KEY",
    "MLFLOW_TRACKING_PASSWORD",
    "MLFLOW_TRACKING_TOKEN",
    "DATABRICKS_TOKEN",
)
"""Variables that hold a key: in ``environment`` they would be stored in the run."""
_URIS = ("MLFLOW_TRACKING_URI", "MLFLOW_REGISTRY_URI", "WANDB_BASE_URL")
"""Variables that may hold one."""


def _uri(value: str) -> str:
    if _has_credential(value):
        raise ValueError(
            "a password would be stored in the run; give MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD as secrets"
        )
    return value


def _has_credential(uri: str) -> bool:
    """Whether a URI names a user, or a password among its parameters."""
    return bool(re.match(r"[^/]*//[^/]*@", uri) or re.search(r"[?&](password|token|secret|key)=", uri, re.IGNORECASE))


class WandB(Section):
    """Weights & Biases. Missing keys follow from ``WANDB_*`` variables."""

    project: str | None = Field(default=None, min_length=1, max_length=128, description="by default the task's name")
    entity: str | None = Field(default=None, min_length=1, description="user or team")
    group: str | None = Field(default=None, min_length=1, max_length=128)
    tags: list[str] = Field(default_factory=list, max_length=64)
    mode: Literal["online", "offline"] | None = Field(
        default=None, description="offline: into the run's directory, for `wandb sync`"
    )


class MLflow(Section):
    """MLflow. Missing keys follow from ``MLFLOW_*`` variables."""

    uri: Annotated[str, AfterValidator(_uri)] | None = Field(
        default=None, min_length=1, description="of the tracking server, or sqlite:///PATH"
    )
    experiment: str | None = Field(default=None, min_length=1, description="by default the task's name")
    tags: dict[str, str] = Field(default_factory=dict)


class TrackingServices(Section):
    """Services that get the metrics of a training: ``wandb``, ``[wandb, mlflow]``, or each with its settings."""

    wandb: WandB | None = None
    mlflow: MLflow | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_names(cls, value: object) -> object:
        if isinstance(value, Mapping):
            return {name: {} if settings is None else settings for name, settings in value.items()}
        names = [value] if isinstance(value, str) else value
        if not isinstance(names, list):
            raise ValueError("expected wandb, mlflow, a list of them, or each with its settings")
        for name in names:
            if name not in SERVICES:
                raise ValueError(f"no service is called {shown(str(name))}; {nearest(str(name), list(SERVICES))}")
        return {name: {} for name in names}


def key_in(environment: Mapping[str, str]) -> str | None:
    """The first variable of a job's ``environment`` that holds a service's key."""
    held = (
        name for name, value in environment.items() if name in CREDENTIALS or (name in _URIS and _has_credential(value))
    )
    return next(held, None)


def track_schema(section: dict[str, Any]) -> dict[str, Any]:
    """JSON Schema of ``track``, whose section has the schema ``section``."""
    name = {"enum": list(SERVICES)}
    nullable = {key: {"anyOf": [each, {"type": "null"}]} for key, each in section["properties"].items()}
    return {"anyOf": [name, {"type": "array", "items": name}, {**section, "properties": nullable}]}
