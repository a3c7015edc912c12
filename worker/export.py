"""``python -m worker.export``: write a checkpoint's policy as a bundle of files that run it on a robot (:mod:`worker.deploy.bundle`)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from worker.learning.job import Job, configure, run_command, user_errors

if TYPE_CHECKING:
    from shared_store.volume.checkpoints import Checkpoint
    from shared_store.volume.layout import Run
    from worker.tasks.run.task import Task


def export(
    run: Run, checkpoint: Checkpoint, task: Task, rounds: int = 1, section: Mapping[str, Any] = MappingProxyType({})
) -> Path:
    """Write the bundle of ``checkpoint`` to ``exports/<its name>/``; see :func:`worker.deploy.bundle.export`.

    Args:
        run: Of the checkpoint.
        checkpoint: Whose policy.
        task: Worlds of its task, which are played with.
        rounds: Episodes of each world on which the bundle is judged; 0: it is not.
        section: The job's section, which may accept a changed robot.

    Raises:
        UserError: The task's observations or actions mean something else by now, or its robot changed.
    """
    from worker.deploy import bundle
    from worker.learning.setup import check_contract, contract_from
    from worker.learning.trained import load_policy
    from worker.tasks.run.policy_contract import policy_contract

    changes = check_contract(checkpoint, task, section)
    policy = load_policy(checkpoint)
    acting = policy if task.device == "cpu" else load_policy(checkpoint, task.device)
    contract = policy_contract(task, checkpoint.manifest["task"], policy.module())
    if changes:  # the contract of a policy holds the robots of its training
        then = contract_from(checkpoint.manifest, checkpoint.name)
        contract = replace(contract, robots=then.robots if then else ())
    return bundle.export(run, checkpoint, task, (policy, acting), contract, rounds, changes)


def main() -> int:
    """Export on rank 0; the other ranks, if any, have nothing to do."""
    job = Job.from_env(os.environ, "export")
    if int(os.environ.get("RANK") or 0):
        return 0
    run = job.named_run()
    episodes, worlds = job.setting("episodes", 16, least=0), job.setting("worlds", 16)
    from worker.learning.distributed import RankPlacement, connect, require_gpus, use_cpu_threads
    from worker.learning.trained import find_checkpoint

    checkpoint = find_checkpoint(run, job.section.get("checkpoint"))
    use_cpu_threads(os.environ)
    with user_errors():
        require_gpus(os.environ.get("CUDA_VISIBLE_DEVICES", ""), 0)
    gang = connect(RankPlacement())
    from worker.learning.algorithm import WorldShare
    from worker.learning.randomness import held_out_seed, seed_generators
    from worker.learning.setup import begin_as_trained, build_task
    from worker.tasks import find_task

    facts = checkpoint.manifest
    with user_errors("task"):
        task_type = find_task(facts["task"])
    config = configure(task_type, facts["train"])
    seed = held_out_seed(facts["train"].get("seed", 0))
    seed_generators(seed)
    task = build_task(task_type, config, WorldShare.of(0, 1, worlds), gang, seed)
    begin_as_trained(task, checkpoint)
    target = export(run, checkpoint, task, -(-episodes // worlds), job.section)
    print(f"exported: {target}", flush=True)
    gang.close()
    return 0


if __name__ == "__main__":
    run_command(main)
