"""``python -m worker.evaluate``: one rank of a job that evaluates a checkpoint, without noise, on worlds held out from its training."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from shared_store.contract import plugins
from shared_store.volume.node_outcomes import EX_TEMPFAIL
from shared_store.volume.run_settings import merged
from shared_store.volume.texts import beside, keep
from worker.learning.job import Job, StopRequest, configure, end_startup, run_command, user_errors
from worker.settings.errors import UserError

if TYPE_CHECKING:
    from shared_store.contract.plugins import EvaluationRules
    from worker.evaluation.evaluation import Watcher
    from worker.tasks.run.task import Task

EPISODES = 100
WORLDS = 1024
"""Greatest number of worlds that a rank simulates at once, unless the job says more."""


def main(kind: str = "evaluate") -> int:
    """Evaluate; returns the exit code: 0 done, 75 left on request (started again, it begins anew).

    Args:
        kind: The key of the job's section: ``evaluate``, or that of a plug-in's, whose rules say how many episodes there are.
    """
    stop = StopRequest().listen()  # before the imports, which take seconds
    job = Job.from_env(os.environ, kind)
    run, section, rules = job.named_run(), plugins.sections().get(kind), plugins.rules_of(kind)
    episodes = job.setting(*rules.count if rules else ("episodes", EPISODES))
    from worker.learning.distributed import connect_rank

    gang = connect_rank(os.environ)
    from shared_store.volume.evaluations import lines
    from worker.evaluation.episodes import SIZE, Blocks, Stopped, play
    from worker.evaluation.evaluation import result_of
    from worker.learning.algorithm import WorldShare
    from worker.learning.randomness import held_out_seed, seed_generators
    from worker.learning.setup import begin_as_trained, build_task, check_contract
    from worker.learning.trained import choose_checkpoint, load_policies
    from worker.tasks import find_task

    checkpoint = choose_checkpoint(gang, run, job.section.get("checkpoint"))
    facts = checkpoint.manifest
    with user_errors("task"):
        task_type = find_task(facts["task"])
    changes = job.section.get("config") or {}
    if rules:
        changes = _changes(rules, job, kind, task_type, gang.size)
    trained = facts["train"]
    config = configure(task_type, {**trained, "config": merged(trained.get("config") or {}, changes)}, kind)
    seed = job.setting("seed", held_out_seed(trained.get("seed", 0)), least=0)
    seed_generators(seed)
    size = episodes if rules else SIZE  # by rules, each episode has a world, and there are no further ones beside them
    blocks = math.ceil(min(job.setting("worlds", WORLDS) * gang.size, episodes) / size)
    dealt = WorldShare.of(gang.rank, gang.size, max(blocks, gang.size))
    share, total = WorldShare(dealt.first * size, dealt.count * size, dealt.total * size), dealt.total * size

    def build(first: int) -> Task:
        task = build_task(task_type, config, WorldShare(first + share.first, share.count, total), gang, seed)
        begin_as_trained(task, checkpoint)
        return task

    task = build(0)
    if gang.is_main and (notes := task.notes()):
        print("\n".join(notes), flush=True)
    # a GPU adds in no fixed order: there one batch is faster, and blocks would make no two evaluations equal
    policies = load_policies(checkpoint, gang.device, dealt.count if gang.device == "cpu" else 1)
    policy = Blocks(policies, size) if gang.device == "cpu" else policies[0]
    check_contract(checkpoint, task, job.section)
    end_startup()
    started = time.perf_counter()
    rounds = _rounds(task, build, math.ceil(episodes / total), total, seed)
    watcher: Watcher | None = plugins.load(section.watcher)(task) if section else None
    watch = watcher.note if watcher else None
    try:
        played = play(rounds, policy, gang, episodes=episodes, is_stop_requested=lambda: stop.requested, watch=watch)
    except Stopped:
        if gang.is_main:
            print(
                "stop requested: nothing was recorded; the evaluation begins anew when it is started again",
                flush=True,
            )
        return EX_TEMPFAIL
    result = result_of(task, played, checkpoint.name, seed, started)
    if gang.is_main:
        if not watcher:
            print(result, flush=True)
        known = {"keep": job.section.get("keep", True), **_circumstances(facts)}
        judged = {kind: watcher.result(played, job.section, seed, facts)} if watcher else {}
        shown, texts = beside({kind: {"config": changes}})
        for text in texts.values():  # such as a reward function, which explains this evaluation later
            keep(run.texts, text.encode())
        summary = result.write(
            run, job.id, judged, iteration=checkpoint.iteration, config=shown[kind]["config"], **known
        )
        print("\n".join(lines(summary)), flush=True)
        print(f"written: {run.evaluations / summary['table']} and .json", flush=True)
    gang.close()
    return 0


def _changes(rules: EvaluationRules, job: Job, kind: str, task_type: type[Task], ranks: int) -> dict[str, Any]:
    """The section's changes to the training's configuration. Raises UserError for a task that has no such evaluations, and for several
    ranks."""
    if words := rules.refusal(task_type.config_type):
        raise UserError(f"{kind}: run {job.section.get('run')} trained {task_type.__name__}, {words}")
    if ranks > 1:
        raise UserError(f"{kind}: it runs on one node with at most one GPU, not on {ranks} ranks")
    if not isinstance(job.section.get("config") or {}, dict):
        raise UserError(f"{kind}.config: expected an object")
    return rules.changes(job.section)


def _rounds(task: Task, build: Callable[[int], Task], count: int, total: int, seed: int) -> Iterator[Task]:
    """The worlds of each round: those of the global indices ``round * total`` and on, whatever the rounds before did to them."""
    from worker.learning.report import Failures

    say = partial(print, flush=True)
    yield task
    for number in range(1, count):
        if task.config.randomize.draws_worlds:  # when they are built
            Failures(task, say).report()
            task = build(number * total)
        else:
            task.restart(seed, task.first_world + total)
        yield task
    Failures(task, say).report()


def _circumstances(facts: Mapping[str, Any]) -> dict[str, Any]:
    """With what the evaluation was done."""
    import newton
    import torch
    import warp

    from shared_store import __version__

    return {
        "algorithm": facts.get("algorithm"),
        "versions": {
            "muster": __version__,
            "torch": torch.__version__,
            "warp": warp.__version__,
            "newton": newton.__version__,
        },
    }


if __name__ == "__main__":
    run_command(main)
