"""``python -m worker.evaluate``: one rank of a job that evaluates a checkpoint, without noise, on fresh worlds."""

from __future__ import annotations

import os

from worker.errors import UserError
from worker.learning.job import Job, configure, end_startup, run_command, user_errors


def main() -> int:
    """Evaluate; returns the exit code."""
    job = Job.from_env(os.environ, "evaluate")
    run = job.named_run()
    episodes = job.setting("episodes", 1)
    from worker.distributed import REPORT_SECONDS, Placement, connect, require_gpus, use_cpu_threads

    use_cpu_threads(os.environ)
    with user_errors():
        placement = Placement.from_env(os.environ)
        require_gpus(os.environ.get("CUDA_VISIBLE_DEVICES", ""), placement.local_rank)
    gang = connect(placement, report_seconds=float(os.environ.get("MUSTER_REPORT_SECONDS") or REPORT_SECONDS))
    from worker.learning.algorithm import Share
    from worker.learning.evaluation import evaluate
    from worker.learning.randomness import held_out_seed, seed_generators
    from worker.learning.setup import build_task, spaces_from, spaces_of
    from worker.learning.trained import choose_checkpoint, load_policy
    from worker.tasks import find_task
    from worker.tasks.adapting import begin_evaluation

    checkpoint = choose_checkpoint(gang, run, job.section.get("checkpoint"))
    facts = checkpoint.manifest
    with user_errors("task"):
        task_type = find_task(facts["task"])
    config = configure(task_type, facts["train"])
    seed = job.setting("seed", held_out_seed(facts["train"].get("seed", 0)), least=0)
    seed_generators(seed)
    share = Share.of(gang.rank, gang.size, job.setting("worlds", 64) * gang.size)
    task = build_task(task_type, config, share, gang, seed)
    told = max(0, checkpoint.iteration - 1), facts.get("reward"), facts.get("episode_length")
    begin_evaluation(task, *told, facts.get("adaptive_steps", {}))
    policy = load_policy(checkpoint, gang.device)
    if (then := spaces_from(facts["policy"])) != (now := spaces_of(task)):
        raise UserError(
            f"checkpoint {checkpoint.name} does not fit task {facts['task']} as it is now: it had {then}, it has {now}"
        )
    end_startup()
    result = evaluate(task, policy, gang, checkpoint=checkpoint.name, episodes=episodes * share.total)
    if gang.is_main:
        print(result, flush=True)
        print(f"written: {result.write(run)}", flush=True)
    gang.close()
    return 0


if __name__ == "__main__":
    run_command(main)
