"""The model registry: ``models/<name>/<version>/``, policies that were chosen to be kept, each written once and never again.

A version holds ``bundle/`` (:mod:`shared_store.bundles`), ``model.json`` (where the policy comes from, and how it was evaluated) and
``manifest.json`` with the digest of every file. Versions count up from 1. A version appears by a rename that fails where there is
one of that number already, so several who register at once get several versions, and none is ever overwritten.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared_store import bundles
from shared_store.bundles import DamagedBundle
from shared_store.checkpoints import Checkpoint
from shared_store.evaluations import list_evaluations
from shared_store.files import read_json, refuse_links, write_json
from shared_store.layout import NAME, Run, Store
from shared_store.policy_contract import Contract
from shared_store.wording import nearest

_VERSION = re.compile(r"[1-9][0-9]{0,8}")


class ModelError(Exception):
    """There is no such model, or it can't be registered; one line that says what there is."""


class AlreadyRegistered(ModelError):
    """A version of the model has this checkpoint."""


class UnknownModel(ModelError):
    """There is no model, or no version, of that name."""


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
        try:
            found = read_json(self.path / "model.json")
        except (OSError, ValueError) as error:
            raise DamagedBundle(f"model {self.reference}: model.json can't be read ({error})") from error
        if found is None:
            raise DamagedBundle(f"model {self.reference}: model.json is missing")
        return found

    def contract(self) -> Contract:
        """Of its policy. Raises DamagedBundle."""
        return bundles.read_contract(self.bundle)

    def verify(self) -> None:
        """Raises DamagedBundle, naming the first file that is altered, missing or added."""
        bundles.verify(self.path)
        bundles.verify(self.bundle)


def check_name(name: str) -> None:
    """Raise ModelError for what no model can be called: a name becomes a directory."""
    if not NAME.fullmatch(name):
        raise ModelError(
            f"model name {name[:130]!r}: use letters, digits, '.', '_' and '-' only, at most 128 of them, the first a letter or digit"
        )


def model_names(store: Store) -> list[str]:
    """Names of all models that have a version."""
    try:
        names = sorted(entry.name for entry in os.scandir(store.models) if NAME.fullmatch(entry.name))
    except FileNotFoundError:
        return []
    return [name for name in names if versions(store, name)]


def versions(store: Store, name: str) -> list[Model]:
    """The versions of a model, the newest last. Raises ModelError for a name that no model can have, DamagedFile for a link."""
    check_name(name)
    folder = store.models / name
    refuse_links(folder, 2)
    try:
        entries = os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return []
    return [Model(folder / str(n), name, n) for n in sorted(int(each) for each in entries if _VERSION.fullmatch(each))]


def find(store: Store, name: str, version: int | None = None) -> Model:
    """A version of a model, the newest where none is named. Raises UnknownModel with the nearest name, or the versions that there are."""
    found = versions(store, name)
    if not found:
        known = model_names(store)
        hint = nearest(name, known, "" if known else "no model is registered yet")
        raise UnknownModel(f"model {name} does not exist; {hint}")
    if version is None:
        return found[-1]
    for model in found:
        if model.version == version:
            return model
    there = ", ".join(str(model.version) for model in found)
    raise UnknownModel(f"model {name} has no version {version}; there are: {there}")


_in_progress: set[Path] = set()
"""Hidden directories of registrations that go on in this process."""


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

    What a registration of the same registrar left behind when it was killed is deleted first.

    Args:
        store: Of the models.
        name: Of the model.
        run: Of the checkpoint.
        checkpoint: It was exported.
        facts: What else ``model.json`` says: who registered it, for whom.
        registrar: Id of the controller, under which no other process registers at the same time.
        again: Whether a checkpoint that is a version of the model already becomes another one.

    Raises:
        AlreadyRegistered: The checkpoint is a version of the model, and ``again`` is false; nothing is made.
        ModelError: No model can be called so, or the checkpoint has no bundle.
        DamagedBundle: The bundle is not as it was exported.
        OSError, DamagedFile: The volume is full or gone, or has a link where a directory should be.
    """
    bundle = run.exports / checkpoint.name
    check_name(name)
    refuse_links(bundle, 2)
    if not bundle.is_dir():
        reference = f"{run.name}@{checkpoint.iteration}"
        raise ModelError(
            f"checkpoint {checkpoint.name} of run {run.name} is not exported; export it first: muster export {reference}"
        )
    folder = store.models / name
    refuse_links(folder, 2)
    folder.mkdir(parents=True, exist_ok=True)
    hidden = folder / f".{registrar}.{uuid.uuid4().hex}.tmp"
    _in_progress.add(hidden)
    try:
        _clear_leftovers(store, registrar)
        hidden.mkdir()
        bundles.copy_files(bundle, hidden / "bundle")
        lineage = _lineage(run, checkpoint, bundles.read_manifest(hidden / "bundle"))
        while True:
            there = versions(store, name)
            if not again and (same := _version_of(there, lineage)) is not None:
                raise AlreadyRegistered(
                    f"the same checkpoint is {same.reference} already; --again registers it once more"
                )
            version = there[-1].version + 1 if there else 1
            model = Model(folder / str(version), name, version)
            write_json(hidden / "model.json", {**facts, **lineage, "name": name, "version": version})
            (hidden / bundles.MANIFEST).unlink(missing_ok=True)
            bundles.seal(hidden, {"model": model.reference, "created": time.time()})
            for path in hidden.rglob("*"):
                if path.is_file():
                    path.chmod(0o444)
            # where another was faster, its version stands and this one is the next: a directory with files in it is never replaced
            with contextlib.suppress(FileExistsError):
                bundles.publish(hidden, model.path)
                return model
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
        _in_progress.discard(hidden)


def _version_of(there: Sequence[Model], lineage: Mapping[str, Any]) -> Model | None:
    """The newest version that is of the same checkpoint: by its files, since another run may have had the name of this one."""
    for model in reversed(there):
        with contextlib.suppress(DamagedBundle):
            facts = model.facts()
            if all(facts.get(key) == lineage[key] for key in ("run", "checkpoint", "checkpoint_files")):
                return model
    return None


def _clear_leftovers(store: Store, registrar: str) -> None:
    """Delete what registrations of this controller left, of any model, when it was killed; of others nobody knows whether they go on."""
    for path in store.models.glob(f"*/.{registrar}.*.tmp") if registrar else ():
        if path not in _in_progress and not path.parent.is_symlink():
            shutil.rmtree(path, ignore_errors=True)


def _lineage(run: Run, checkpoint: Checkpoint, manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Where a policy comes from, and what is known of how good it is."""
    description = run.description() or {}
    judged = (read_json(run.exports / checkpoint.name / bundles.REPORT) or {}).get("judged")
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
        "judged": judged,
        "registered": time.time(),
    }
