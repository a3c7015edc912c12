"""``python -m worker.export``: write a checkpoint's policy as one ONNX file, with what its numbers mean on a robot.

``exports/<checkpoint>/policy.onnx`` takes ``obs``, shape (batch, observations), or, for a camera, (batch, channels, height, width) as
bytes, and gives ``actions``, shape (batch, actions): the mean action, with the observation normaliser inside.
``policy.json`` beside it holds a self-test, the control rate, and, where the task declares its interface, each observation with unit,
scale, offset and (of a command) range, and each action with joint, unit, scale, offset, clip, default position, gains and effort limit
(:mod:`worker.tasks.interface`). The file is run with ONNX's own reference evaluator, and compared, before the directory appears.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import shutil
import time
import uuid
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shared_store.checkpoints import Checkpoint
from shared_store.files import remove_tree, sync_directory, write_atomic, write_json
from shared_store.layout import Run
from worker.errors import TrainingError, UserError
from worker.learning.job import Job, run_command

if TYPE_CHECKING:
    import numpy as np

    from worker.learning.algorithm import ExportedPolicy

STEPS = 3
"""Steps in which an exported policy is compared, each with other observations: in one step nobody sees what a policy remembers."""
TOLERANCE = 1e-5
"""Greatest absolute difference between the exported and the trained policy's actions."""


def export(run: Run, checkpoint: Checkpoint) -> Path:
    """Export ``checkpoint`` to ``exports/<its name>/``, as a whole or not at all; returns that directory.

    Raises TrainingError where the exported file computes something else than the policy, and UserError where the policy has a memory that
    its :meth:`worker.learning.algorithm.Policy.module` does not have; nothing is published then.
    """
    import numpy as np
    import torch

    from worker.learning.trained import load_policy

    policy = load_policy(checkpoint)
    facts, exported = checkpoint.manifest, policy.module()
    count = exported.sample.batch_size[0]
    seen = [exported.sample[(torch.arange(count) + step) % count] for step in range(STEPS)]
    policy.reset()
    # as it was trained, not as it is exported
    actions = [policy.act(observations).numpy().copy() for observations in seen]
    policy.reset()
    if not exported.states and np.abs(policy.act(seen[-1]).numpy() - actions[-1]).max() > TOLERANCE:
        raise UserError(
            f"the policy of algorithm {facts['algorithm']} remembers what it saw before, but its module() has no recurrent state among "
            "inputs and outputs; not published"
        )
    fed = [{name: tensor.numpy() for name, tensor in exported.named(each).items()} for each in seen]
    few = 8 if all(tensor.ndim == 2 for tensor in fed[0].values()) else 1
    metadata = {
        "format": 1,
        "task": facts["task"],
        "run": run.name,
        "checkpoint": checkpoint.name,
        "iteration": checkpoint.iteration,
        "reward": facts.get("reward"),
        **facts["policy"],
        "input": "obs",
        "output": "actions",
        **({"state": {name: list(exported.inputs[name].shape) for name in exported.states}} if exported.states else {}),
        "self_test": {
            **{name: tensor[:few].tolist() for name, tensor in fed[0].items()},
            "actions": actions[0][:few].tolist(),
            "tolerance": TOLERANCE,
        },
    }
    model = to_onnx(exported, metadata)
    metadata["max_difference"] = check(model, exported, fed, actions)
    metadata["sha256"] = hashlib.sha256(model).hexdigest()
    metadata["created"] = time.time()
    target = run.exports / checkpoint.name
    hidden = run.exports / f".{checkpoint.name}.{uuid.uuid4().hex[:8]}.tmp"
    try:
        write_atomic(hidden / "policy.onnx", model)
        write_json(hidden / "policy.json", metadata)
        if target.exists():
            remove_tree(target)
        os.rename(hidden, target)
        sync_directory(run.exports)
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
    return target


def to_onnx(policy: ExportedPolicy, metadata: dict[str, Any]) -> bytes:
    """The policy as one self-contained ONNX file, batch size free; ``metadata`` is inside, as JSON under ``muster``."""
    import onnx
    import torch

    inputs, outputs = list(policy.inputs), list(policy.outputs)
    buffer = io.BytesIO()
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        # torch's newer exporter takes ten times as long here and writes two files by default
        warnings.simplefilter("ignore")
        torch.onnx.export(
            policy.network,
            tuple(policy.inputs.values()),
            buffer,
            dynamo=False,
            opset_version=18,
            input_names=inputs,
            output_names=outputs,
            dynamic_axes={name: {0: "batch"} for name in (*inputs, *outputs)},
        )
    model = onnx.load_from_string(buffer.getvalue())
    # the comma-separated keys are those that other consumers of RL policies read
    lists = {key: ",".join(value) for key, value in metadata.items() if key.endswith("_names")}
    onnx.helper.set_model_props(model, {"muster": json.dumps(metadata), **lists})
    onnx.checker.check_model(model)
    return model.SerializeToString()


def check(
    model: bytes, exported: ExportedPolicy, fed: Sequence[Mapping[str, np.ndarray]], actions: Sequence[np.ndarray]
) -> float:
    """Run ``model`` with ONNX's reference evaluator; the greatest difference to ``actions``. Raises TrainingError above the tolerance.

    Args:
        fed: The observations of each step; a recurrent policy begins with a state of zeros.
        actions: What the policy does in each step, shape (n, actions).
    """
    import numpy as np
    import onnx
    from onnx.reference import ReferenceEvaluator

    evaluator, count = ReferenceEvaluator(onnx.load_from_string(model)), len(actions[0])
    states = {name: np.zeros((count, *exported.inputs[name].shape[1:]), dtype=np.float32) for name in exported.states}
    difference = 0.0
    for observed, wanted in zip(fed, actions, strict=True):
        found, *after = evaluator.run(None, {**observed, **states})
        states = dict(zip(states, after, strict=True))
        difference = max(difference, float(np.abs(found - wanted).max()))
    if not difference <= TOLERANCE:
        raise TrainingError(
            f"the exported policy differs from the trained one by {difference:g} (at most {TOLERANCE:g} is allowed); not published"
        )
    return difference


def main() -> int:
    """Export on rank 0; the other ranks, if any, have nothing to do."""
    job = Job.from_env(os.environ, "export")
    if int(os.environ.get("RANK") or 0):
        return 0
    run = job.named_run()
    from worker.learning.trained import find_checkpoint

    target = export(run, find_checkpoint(run, job.section.get("checkpoint")))
    print(f"exported: {target / 'policy.onnx'}", flush=True)
    return 0


if __name__ == "__main__":
    run_command(main)
