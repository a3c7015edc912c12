"""The model registry: ``models/<name>/<version>/``, immutable versions of policies.

A version holds ``bundle/`` (:mod:`shared_store.volume.bundles`), ``model.json`` (the policy's lineage and evaluations) and
``manifest.json`` with the digest of every file. Versions count up from 1. A version appears by a rename that fails if its number
exists, so simultaneous registrations get different versions, and none is ever overwritten.
"""

from __future__ import annotations

import contextlib
import os
import re
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared_store.contract.error_text import nearest
from shared_store.contract.policy import Contract
from shared_store.volume import bundles
from shared_store.volume.bundles import DamagedBundle
from shared_store.volume.checkpoints import Checkpoint
from shared_store.volume.evaluations import list_evaluations
from shared_store.volume.files import hidden_folder, read_json, refuse_links, write_json
from shared_store.volume.layout import Run, Store, check_name, names_in

_VERSION = re.compile(r"[1-9][0-9]{0,8}")


class ModelError(Exception):
    """A model does not exist or can't be registered; one line that names the alternatives."""


class AlreadyRegistered(ModelError):
    """A version of the model has this checkpoint."""


class UnknownModel(ModelError):
    """The model or version does not exist."""


@dataclass(frozen=True)
class Model:
    """A version of a model."""

    path: Path
    name: str
    version: int

    @property
    def reference(self) -> str:
        """``NAME@VERSION``."""
        return f"{self.name}@{self.version}"

    @property
    def bundle(self) -> Path:
        """Its bundle."""
        return self.path / "bundle"

    def facts(self) -> dict[str, Any]:
        """The content of ``model.json``. Raises DamagedBundle."""
        return bundles.read_document(self.path, "model.json", f"model {self.reference}")

    def contract(self) -> Contract:
        """The contract of its policy. Raises DamagedBundle."""
        return bundles.read_contract(self.bundle)

    def verify(self) -> None:
        """Raises DamagedBundle, naming the first file that is altered, missing or added."""
        bundles.verify(self.path)
        bundles.verify(self.bundle)


def model_names(store: Store) -> list[str]:
    """Names of all models that have a version."""
    return [name for name in names_in(store.models) if versions(store, name)]


def versions(store: Store, name: str) -> list[Model]:
    """The versions of a model, the newest last. Raises ModelError for an invalid name, DamagedFile for a link."""
    check_name("model", name, ModelError)
    folder = store.models / name
    refuse_links(folder, 2)
    entries = os.listdir(folder) if folder.is_dir() else ()
    return [Model(folder / str(n), name, n) for n in sorted(int(each) for each in entries if _VERSION.fullmatch(each))]


def find(
    store: Store, name: str, version: int | None = None, visible: Callable[[Model], bool] = lambda model: True
) -> Model:
    """A version of a model, by default the newest. Raises UnknownModel with the nearest name, or the existing versions.

    ``visible``: whether the caller may see the model with this newest version; others are as if they did not exist.
    """
    found = versions(store, name)
    if not found or not visible(found[-1]):
        known = [each for each in model_names(store) if visible(versions(store, each)[-1])]
        hint = nearest(name, known, "" if known else "no model is registered yet")
        raise UnknownModel(f"model {name} does not exist; {hint}")
    if version is None:
        return found[-1]
    if model := next((model for model in found if model.version == version), None):
        return model
    existing = ", ".join(str(model.version) for model in found)
    raise UnknownModel(f"model {name} has no version {version}; available: {existing}")


def register(
    store: Store,
    name: str,
    run: Run,
    checkpoint: Checkpoint,
    facts: Mapping[str, Any],
    registrar: str = "",
    *,
    again: bool = True,
) -> Model:
    """Keep the bundle of a checkpoint as the next version of a model.

    First, it deletes the leftovers of killed registrations by the same registrar.

    Args:
        store: Store of the models.
        name: Name of the model.
        run: Run of the checkpoint.
        checkpoint: An exported checkpoint.
        facts: Further entries of ``model.json``: who registered it, for whom.
        registrar: Id of the controller; no other process registers under it at the same time.
        again: Whether to register a checkpoint that is already a version of the model once more.

    Raises:
        AlreadyRegistered: The checkpoint is a version of the model, and ``again`` is false; nothing is made.
        ModelError: The name is invalid, or the checkpoint has no bundle.
        DamagedBundle: The bundle was altered after its export.
        OSError, DamagedFile: The volume is full or gone, or has a link in place of a directory.
    """
    bundle = run.exports / checkpoint.name
    check_name("model", name, ModelError)
    refuse_links(bundle, 2)
    if not bundle.is_dir():
        reference = f"{run.name}@{checkpoint.iteration}"
        raise ModelError(
            f"checkpoint {checkpoint.name} of run {run.name} is not exported; export it first: muster export {reference}"
        )
    folder = store.models / name
    refuse_links(folder, 2)
    hidden = folder / f".{registrar}.{uuid.uuid4().hex}.tmp"
    with hidden_folder(hidden, store.models.glob(f"*/.{registrar}.*.tmp") if registrar else (), levels=2):
        (hidden / "bundle").mkdir()
        bundles.copy_files(bundle, hidden / "bundle")
        lineage = _lineage(run, checkpoint, bundles.read_manifest(hidden / "bundle"))
        while True:
            existing = versions(store, name)
            if not again and (same := _version_of(existing, lineage)) is not None:
                raise AlreadyRegistered(
                    f"the same checkpoint is {same.reference} already; --again registers it once more"
                )
            version = existing[-1].version + 1 if existing else 1
            model = Model(folder / str(version), name, version)
            write_json(hidden / "model.json", {**facts, **lineage, "name": name, "version": version})
            (hidden / bundles.MANIFEST).unlink(missing_ok=True)
            bundles.seal(hidden, {"model": model.reference, "created": time.time()})
            for path in hidden.rglob("*"):
                if path.is_file():
                    path.chmod(0o444)
            # if another registration was faster, this one is the next version: a rename never replaces a non-empty directory
            with contextlib.suppress(FileExistsError):
                bundles.publish(hidden, model.path)
                return model


def _version_of(existing: Sequence[Model], lineage: Mapping[str, Any]) -> Model | None:
    """The newest version of the same checkpoint, compared by its files, since an earlier run may have had the same name."""
    for model in reversed(existing):
        with contextlib.suppress(DamagedBundle):
            facts = model.facts()
            if all(facts.get(key) == lineage[key] for key in ("run", "checkpoint", "checkpoint_files")):
                return model
    return None


def _lineage(run: Run, checkpoint: Checkpoint, manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The origin of a policy, and its known scores."""
    description = run.description() or {}
    report = read_json(run.exports / checkpoint.name / bundles.REPORT) or {}
    return {
        "run": run.name,
        "checkpoint": checkpoint.name,
        "iteration": checkpoint.iteration,
        "parent": description.get("parent"),
        "spec": description.get("spec"),
        **{key: manifest.get(key) for key in ("task", "train", "settings", "algorithm", "code")},
        "made_with": manifest.get("versions"),
        "checkpoint_files": manifest.get("checkpoint_files"),
        "bundle": manifest.get("digest"),
        "score": manifest.get("score"),
        "evaluations": [each for each in list_evaluations(run) if each.get("checkpoint") == checkpoint.name],
        "judged": report.get("judged"),
        "changed_robot": report.get("changed_robot"),
        "registered": time.time(),
    }
