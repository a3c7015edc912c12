"""A checkpoint's policy as a bundle: files that run it on a robot, compared with it before they appear.

==================  ==========================================================================================================
``policy.onnx``     the mean action, the normaliser inside, batch size free; recurrent state as inputs and outputs
``policy.pt``       the same as TorchScript
``contract.json``   what goes in and what comes out (:mod:`shared_store.contract.policy`)
``parity.npz``      observations of roll-outs, and what the trained policy did: a self-test for who runs the bundle
``report.json``     how the files were compared with the trained policy, and how both did on the same worlds
``leapp.yaml``      the same inputs and outputs as NVIDIA's LEAPP describes them (:mod:`worker.deploy.model_file`)
``robot/``          the robot's model, where its licence allows a copy
``*.json``          what the task and plug-ins say besides
``README.md``       what is what, and licences
``manifest.json``   where the policy comes from, versions, and the SHA-256 of every other file
==================  ==========================================================================================================
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import io
import json
import platform
import re
import shutil
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import worker.tasks.library
from shared_store import __version__
from shared_store.contract.error_text import shown
from shared_store.contract.plugins import blamed, load, plugins
from shared_store.contract.policy import Contract
from shared_store.volume.bundles import CONTRACT, MANIFEST, REPORT, publish, seal
from shared_store.volume.checkpoints import Checkpoint
from shared_store.volume.files import make_directory, remove_tree, write_json
from shared_store.volume.layout import Run
from worker.deploy import parity
from worker.deploy.model_file import (
    LEAPP,
    OPSET,
    OnnxPolicy,
    ScriptPolicy,
    leapp_description,
    metadata_of,
    to_onnx,
    to_torchscript,
)
from worker.settings.errors import UserError
from worker.simulation import robot_files

if TYPE_CHECKING:
    from worker.learning.algorithm import ExportedPolicy, Policy
    from worker.tasks.run.task import Task


COPIED = ("iteration", "reward", "score", "score_error", "score_episodes", "env_steps", "algorithm")
"""Keys that a bundle's manifest repeats from its checkpoint's."""
PACKAGES = ("torch", "onnx", "onnxruntime", "newton", "warp-lang", "rsl-rl-lib")
"""Whose versions the manifest has."""


def bundle_files(
    policy: Policy,
    exported: ExportedPolicy,
    contract: Contract,
    algorithm: str,
    recordings: Mapping[str, parity.RecordedObservations],
    run_path: str = "",
) -> tuple[dict[str, bytes], dict[str, Any]]:
    """The files of a policy by name, compared with it on the recordings and on the policy's own sample; and the result of the comparison.

    Args:
        policy: As it was trained, on the CPU.
        exported: What its ``module()`` gave.
        contract: Its inputs, outputs and states.
        algorithm: Its name, for errors.
        recordings: By name; those that are called ``rollout`` and ``extremes`` go into ``parity.npz``.
        run_path: Run and checkpoint, for the metadata.

    Raises:
        TrainingError: A file computes something else than the policy.
        UserError: The policy has a memory that its ``module()`` does not have.
    """
    groups = {group.input: group.name for group in contract.groups}
    compared = {**recordings, "made_up": parity.made_up(exported)}
    for recording in compared.values():
        if len(recording.begins) > 1:
            first = {name: each[: parity.STEPS] for name, each in recording.inputs.items()}
            start = parity.RecordedObservations(first, recording.begins[: parity.STEPS])
            parity.refuse_hidden_memory(policy, exported, algorithm, start, groups)
    onnx, torchscript = to_onnx(exported, metadata_of(contract, run_path)), to_torchscript(exported)
    models = {"onnx": OnnxPolicy(onnx, contract), "torchscript": ScriptPolicy(torchscript, contract)}
    found = dict.fromkeys(models, 0.0)
    arrays: dict[str, np.ndarray] = {}
    for name, recording in compared.items():
        actions = parity.trained_actions(policy, recording, groups)
        for kind, model in models.items():
            found[kind] = max(found[kind], parity.compare(kind, model, recording, actions))
        if name == "rollout":
            arrays |= {**recording.inputs, "begins": recording.begins, "actions": actions}
        elif name == "extremes":
            arrays |= {f"extreme_{key}": each[0] for key, each in recording.inputs.items()}
            arrays["extreme_actions"] = actions[0]
    report = {
        "tolerance": parity.TOLERANCE,
        "greatest_difference": found,
        "observations": {name: recording.count for name, recording in compared.items()},
        "resets": compared["rollout"].resets if "rollout" in compared else 0,
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return {"policy.onnx": onnx, "policy.pt": torchscript, "parity.npz": buffer.getvalue()}, report


def export(
    run: Run,
    checkpoint: Checkpoint,
    task: Task,
    policies: tuple[Policy, Policy],
    contract: Contract,
    rounds: int = 1,
    changes: str = "",
) -> Path:
    """Write the bundle of a checkpoint to ``exports/<its name>/``, as a whole or not at all; returns that directory.

    Args:
        run: Of the checkpoint.
        checkpoint: Whose policy.
        task: Worlds of its task, which are played with.
        policies: Its policy on the CPU, and on the task's device.
        contract: Its contract, with the policy's inputs and states.
        rounds: Episodes of each world on which the bundle is judged; 0: it is not.
        changes: The accepted changes of the task's robots since the training, in a sentence; empty without any.

    Raises:
        TrainingError: A file computes something else than the policy, or does worse on the task's worlds; nothing is published then.
        UserError: The policy has a memory that its ``module()`` does not have, or a document of the task or of a plug-in can't be in
            a bundle.
    """
    policy, acting = policies
    documents = bundle_documents(task, checkpoint.manifest["algorithm"])
    exported = policy.module()
    groups = {group.input: group.name for group in contract.groups}
    begin = task.state_dict()
    extremes = parity.Extremes(acting, groups) if all(len(group.shape) == 1 for group in contract.groups) else None
    trained = parity.play(task, extremes or acting, rounds) if rounds else None
    recordings = {"rollout": parity.record(task, acting, groups)}
    if extremes and rounds:
        recordings["extremes"] = parity.single(extremes.inputs())
    run_path = f"{run.name}/{checkpoint.name}"
    files, compared = bundle_files(policy, exported, contract, checkpoint.manifest["algorithm"], recordings, run_path)
    report: dict[str, Any] = {"parity": compared, "judged": None, "changed_robot": changes or None}
    if trained:
        task.load_state_dict(begin)  # the same worlds, and the same random numbers from there on
        played = parity.play(task, OnnxPolicy(files["policy.onnx"], contract), rounds)
        runtime = f"onnxruntime {metadata.version('onnxruntime')}"
        report["judged"] = {"runtime": runtime, **parity.judge(trained, played)}
    return _publish(run, checkpoint, task, contract, files, documents, report)


def _publish(
    run: Run,
    checkpoint: Checkpoint,
    task: Task,
    contract: Contract,
    files: Mapping[str, bytes],
    documents: Mapping[str, Mapping[str, Any]],
    report: Mapping[str, Any],
) -> Path:
    target = run.exports / checkpoint.name
    hidden = run.exports / f".{checkpoint.name}.{uuid.uuid4().hex[:8]}.tmp"
    facts = checkpoint.manifest
    try:
        make_directory(hidden, 2)
        for name, data in files.items():
            (hidden / name).write_bytes(data)
        (hidden / LEAPP).write_text(leapp_description(files["policy.onnx"], contract))
        robot = add_robot(task, hidden)
        for name, document in {CONTRACT: contract.document(), REPORT: report, **documents}.items():
            write_json(hidden / name, document)
        (hidden / "README.md").write_text(_readme(run, checkpoint, contract, robot, list(documents)))
        source = inspect.getsourcefile(type(task))
        digest = hashlib.sha256(Path(source).read_bytes()).hexdigest() if source else ""
        versions = {"muster": __version__, "python": platform.python_version()}
        seal(
            hidden,
            {
                "run": run.name,
                "checkpoint": checkpoint.name,
                "checkpoint_files": facts["files"],
                "task": contract.task,
                **{name: facts[name] for name in COPIED if name in facts},
                "train": facts["train"],
                "settings": facts["settings"],
                "parent": (run.description() or {}).get("parent"),
                "robot": robot,
                "opset": OPSET,
                "code": {"module": type(task).__module__, "sha256": digest},
                "versions": {**versions, **{name: metadata.version(name) for name in PACKAGES}},
                "created": time.time(),
            },
        )
        while True:  # until no other process has just published the same checkpoint's
            with contextlib.suppress(FileNotFoundError):
                remove_tree(target)
            with contextlib.suppress(FileExistsError):
                publish(hidden, target)
                return target
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


def _readme(
    run: Run, checkpoint: Checkpoint, contract: Contract, robot: Mapping[str, Any] | None, documents: Sequence[str]
) -> str:
    """The text of ``README.md``."""
    if robot is None:
        about = "The task does not say which file its robot comes from."
    elif robot["file"]:
        about = f"`{robot['file']}` is the robot's model ({robot['source']}); its licence: {robot['licence']}."
    else:
        package = f", of {robot['package']}" if "package" in robot else ""
        about = f"The robot's model is not in the bundle. Its source: `{robot['source']}`{package}; licence: {robot['licence']}."
    further = "".join(f"- `{name}`: what the task or a plug-in says besides.\n" for name in documents)
    return f"""# Policy of task {contract.task}

From run {run.name}, checkpoint {checkpoint.name}, iteration {checkpoint.iteration}. Made by Muster {__version__}.

- `contract.json`: how observations are made and actions are applied, at {contract.control_hz:g} Hz. Its JSON Schema: `muster schema --contract`.
- `policy.onnx`: inputs {", ".join(f"`{group.input}`" for group in contract.groups)}; the normaliser is inside. `policy.pt`: the same as TorchScript.
- `parity.npz`: observations of roll-outs (steps, worlds, ...), where episodes `begins`, and the `actions` of the trained policy. Whoever
  runs the policy should repeat them to within {parity.TOLERANCE:g}.
- `report.json`: how the files were compared with the trained policy, and how both did on the same simulated worlds.
- `leapp.yaml`: the inputs and outputs of `policy.onnx` for NVIDIA's LEAPP. Units, scales and offsets are in `contract.json` alone.
{further}- `manifest.json`: where the policy comes from, versions, and the SHA-256 of every file.

## Licences

The policy, the contract and the recordings belong to whoever trained the policy; Muster claims no rights in them. {about}
"""


_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._+-]{0,194}\.json")
_TAKEN = (CONTRACT, MANIFEST, REPORT)
"""Files of this form that every bundle has."""


def bundle_documents(task: Task, algorithm: str) -> dict[str, Mapping[str, Any]]:
    """The further documents of the bundle of a policy that ``algorithm``, a name, trained; by the names of their files.

    Raises UserError, which names the task or the plug-in: the documents aren't JSON objects, or have a name that is not a plain one, is
    that of a file of every bundle, or is another's. Raises PluginError where a plug-in can't make them.
    """
    found: dict[str, Mapping[str, Any]] = {}
    by: dict[str, str] = {}
    for source, documents in _sources(task, algorithm):
        for name, document in documents.items():
            if not isinstance(name, str) or not _NAME.fullmatch(name):
                problem = f"{shown(name)} can't be a file of a bundle; use a plain name such as notes.json"
            elif name in _TAKEN:
                problem = f"{name} is a file of every bundle; give the document another name"
            elif name in by:
                problem = f"{by[name]} puts {name} into bundles, too; give one of the two documents another name"
            elif not _is_object(document):
                problem = f"{name} is not a JSON object; return a mapping of texts to JSON values"
            else:
                found[name], by[name] = document, source
                continue
            raise UserError(f"{source}: {problem}")
    return found


def _is_object(document: object) -> bool:
    try:
        return isinstance(document, Mapping) and bool(json.dumps(dict(document)))
    except (TypeError, ValueError):
        return False


def _sources(task: Task, algorithm: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    yield f"task {type(task).__name__}: bundle_documents", task.bundle_documents(algorithm)
    for name, plugin in plugins().items():
        if place := plugin.bundle_parts:
            with blamed(place):
                documents = load(place)(task)
            source = f"plug-in {name}: bundle_parts"
            if not isinstance(documents, Mapping):
                raise UserError(f"{source}: {place} returned {shown(documents)}; return documents by their names")
            yield source, documents


_OWN = Path(worker.tasks.library.__file__).parent


def add_robot(task: Task, bundle: Path) -> dict[str, Any] | None:
    """Put the model of the task's robot into ``robot/`` of a bundle where its licence is known to allow that; returns what it is.

    Files of other packages and of users are named with their package and its licence, and not copied: meshes may have licences of
    their own. None of a task without a robot.
    """
    declare = getattr(task, "robot", None)
    if declare is None:
        return None
    text = str(declare(task.config).file)
    found = robot_files.read(text)
    path = Path(found.source)
    if text.lstrip().startswith("<"):
        name = f"robot.{'xml' if found.format == 'mjcf' else found.format}"
        source, licence, data = "the task's own source", "the task's", text.encode()
    elif path.parent == _OWN:
        name = source = path.name
        licence, data = "Apache-2.0", path.read_bytes()
    else:
        scheme, _, inside = text.partition(":")
        package = {"package": inside.partition("/")[0], "newton": "newton"}.get(scheme)
        return {"source": text, "format": found.format, **_package(package), "file": None}
    (bundle / "robot").mkdir(exist_ok=True)
    (bundle / "robot" / name).write_bytes(data)
    return {"source": source, "format": found.format, "licence": licence, "file": f"robot/{name}"}


def _package(name: str | None) -> dict[str, str]:
    if name is None:
        return {"licence": "not known: a file of the task's author"}
    try:
        about = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        return {"package": name, "licence": "not known"}
    licences = (about[key] for key in ("License-Expression", "License") if key in about)
    licence = next(filter(None, licences), "not known")
    return {"package": f"{name} {about['Version']}", "licence": f"{licence.splitlines()[0]} (of the package)"}
