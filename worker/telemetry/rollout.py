"""A rollout of a checkpoint's policy on a few fresh worlds, for recordings and pictures: the mean action, in the order of a control step."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import torch
import warp

from shared_store.volume.checkpoints import Checkpoint
from shared_store.volume.layout import Run
from shared_store.volume.texts import resolved_spec
from worker.learning.job import configure, user_errors
from worker.learning.randomness import held_out_seed, seed_generators
from worker.learning.setup import begin_as_trained, check_contract, observed
from worker.learning.trained import find_checkpoint, load_policy
from worker.tasks import find_task
from worker.telemetry.rows import Rows
from worker.telemetry.stage import Stage
from worker.telemetry.tap import Tap, TapReader

if TYPE_CHECKING:
    from worker.learning.algorithm import Policy
    from worker.settings.task import TaskConfig
    from worker.tasks.run.task import Task


@dataclass(frozen=True)
class Rollout:
    """Worlds on which a policy acts.

    Attributes:
        run: Whose policy.
        checkpoint: Which one.
        config: The task's configuration, that of the training.
        task: The worlds.
        policy: What acts.
        seed: Of the worlds.
    """

    run: Run
    checkpoint: Checkpoint
    config: TaskConfig
    task: Task
    policy: Policy
    seed: int

    @classmethod
    def of(
        cls,
        run: Run,
        section: Mapping[str, Any],
        worlds: int,
        seed: int | None = None,
        device: str | None = None,
    ) -> Rollout:
        """Build the worlds and read the policy.

        Args:
            run: The run.
            section: The job's section: ``checkpoint``, an iteration or a name (the newest where absent), ``accept_changed_robot``.
            worlds: How many.
            seed: Of the worlds; by default one that is not that of the training.
            device: ``"cpu"`` or ``"cuda:<n>"``; None: a GPU where there is one.

        Raises:
            UserError: There is no such checkpoint, or it does not fit the task as it is now.
        """
        checkpoint = find_checkpoint(run, section.get("checkpoint"))
        facts = checkpoint.manifest
        with user_errors("task"):
            task_type = find_task(facts["task"])
        config = configure(task_type, facts["train"])
        seed = held_out_seed(facts["train"].get("seed", 0)) if seed is None else seed
        seed_generators(seed)
        warp.config.log_level = warp.LOG_WARNING
        device = device or ("cuda:0" if torch.cuda.is_available() else "cpu")
        with user_errors():
            task = task_type(config, worlds, seed=seed, device=device)
        begin_as_trained(task, checkpoint)
        policy = load_policy(checkpoint, device)
        check_contract(checkpoint, task, section)
        return cls(run, checkpoint, config, task, policy, seed)

    def stage(self, device: str = "cpu") -> Stage:
        """The appearance of these worlds."""
        with user_errors():
            return Stage(type(self.task), self.config, self.task.world_count, device)

    def steps(self, most: int) -> Iterator[Rows]:
        """Act for at most ``most`` control steps from a fresh reset; after each of them its row."""
        tap = Tap(self.task, self.task.world_count, rows=2)  # one is read while the next is written
        tap.open()
        reading = TapReader(tap)
        self.task.reset()
        self.policy.reset()
        observations = observed(self.task)
        try:
            for _ in range(most):
                self.task.step(self.policy.act(observations))
                self.policy.reset(self.task.dones)
                if torch.cuda.is_available() and self.task.device != "cpu":
                    torch.cuda.synchronize(self.task.device)  # a reading does not wait for the step
                yield reading.take()
        finally:
            tap.close()

    def facts(self) -> dict[str, str]:
        """For the metadata of a recording."""
        learner = self.checkpoint.manifest.get("files", {}).get("learner.pt", {})
        return {
            **facts_of(self.run, self.checkpoint.manifest),
            "checkpoint": self.checkpoint.name,
            "iteration": str(self.checkpoint.iteration),
            "seed": str(self.seed),
            "policy_sha256": str(learner.get("sha256", "")),
        }

    def attachments(self) -> dict[str, bytes]:
        """The policy's contract, the policy as ONNX where its algorithm can export it, and the job that trained it."""
        from worker.deploy.model_file import metadata_of, to_onnx
        from worker.tasks.run.policy_contract import policy_contract

        name, files = self.checkpoint.manifest["task"], {}
        try:
            exported = load_policy(self.checkpoint).module()
            contract = policy_contract(self.task, name, exported)
            files["policy.onnx"] = to_onnx(exported, metadata_of(contract, f"{self.run.name}/{self.checkpoint.name}"))
        except Exception as error:  # of a user's own algorithm: what was recorded is worth more
            what = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            print(f"warning: the recording is without policy.onnx, which can't be exported: {what}", flush=True)
            contract = policy_contract(self.task, name)
        return {"contract.json": as_json(contract.document()), **files, **job_attachment(self.run)}


def facts_of(run: Run, known: Mapping[str, Any]) -> dict[str, str]:
    """Run, task, algorithm and versions, for the metadata of a recording; ``known`` names task and algorithm."""
    versions = {name: version(name) for name in ("muster", "newton", "warp-lang", "torch")}
    return {
        "run": run.name,
        "task": str(known.get("task", "")),
        "algorithm": str(known.get("algorithm", "")),
        **{f"version_{name}": number for name, number in versions.items()},
    }


def job_attachment(run: Run) -> dict[str, bytes]:
    """The YAML of the run's job as JSON, with its long texts; nothing where it had none."""
    spec = (run.description() or {}).get("spec")
    return {"job.json": as_json(resolved_spec(spec, run.texts))} if spec else {}


def as_json(value: object) -> bytes:
    """For an attachment."""
    return json.dumps(value, indent=1).encode()
