"""Jobs that Muster makes itself: evaluations of checkpoints that are due."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from orchestrator.domain.errors import SpecError
from orchestrator.spec.evaluations import Counted, automatic_evaluation, due, evaluation_settings, first_count, place_of
from orchestrator.spec.sections import Evaluation
from shared_store.volume.checkpoints import Checkpoint

TRAINED: dict[str, Any] = {
    "name": "ant",
    "nodes": {"min": 2, "max": 4},
    "resources": {"cpus": 4.0, "gpus": 2, "memory": 2048},
    "environment": {"NOTE": "a"},
    "image": "mine",
    "train": {"task": "Ant", "worlds": 8, "iterations": 100},
}
EVALUATION = Evaluation(every=2, episodes=32, worlds=16)


def saved(*iterations: int, epoch: int = 1) -> list[Checkpoint]:
    return [Checkpoint(Path(f"{each:08d}-e{epoch}"), each, epoch) for each in iterations]


def poll(checkpoints: list[Checkpoint], counted: Counted, *, every: int = 2, busy: bool = False) -> tuple[Counted, int]:
    """What is known after a look, and the iteration that is due; 0 where none is."""
    known, chosen = due(checkpoints, counted, every, 100, busy)
    return known, chosen.iteration if chosen else 0


def test_every_second_checkpoint_of_the_job_is_due_however_many_retention_has_left() -> None:
    known, found = poll(saved(10), Counted())
    assert (known, found) == (Counted("00000010-e1", 1), 0)
    known, found = poll(saved(10), known)
    assert (known, found) == (Counted("00000010-e1", 1), 0), "nothing new"
    known, found = poll(saved(20), known)
    assert (known, found) == (Counted("00000020-e1", 0), 20)
    assert poll(saved(20), known) == (known, 0), "once"
    known, found = poll(saved(20, 30, 40), known)
    assert (known, found) == (Counted("00000040-e1", 0), 40)
    assert first_count([*saved(10, 20), *saved(30, epoch=3)], 3) == Counted("00000020-e1")
    assert first_count(saved(30, epoch=3), 3) == first_count([], 1) == Counted()


def test_one_evaluation_runs_at_a_time_and_the_newest_checkpoint_is_next() -> None:
    known, _ = poll(saved(10, 20), Counted())
    for iterations in ((10, 20, 30), (30, 40), (40, 50), (50, 60), (60, 70)):
        known, found = poll(saved(*iterations), known, busy=True)
        assert found == 0
    assert known == Counted("00000070-e1", 5)
    known, found = poll(saved(60, 70), known)
    assert (known, found) == (Counted("00000070-e1", 0, 1), 70), "40 was due, too"


def test_the_last_checkpoint_is_left_to_the_training_itself_and_a_later_epoch_is_newer() -> None:
    known, found = poll(saved(90, 100), Counted("00000080-e1", 0), every=1)
    assert (known, found) == (Counted("00000100-e1", 1), 0), "the training is done: 90 is not new any more"
    assert poll(saved(90), Counted("00000080-e1", 0), every=1)[1] == 90
    known, found = poll([*saved(50, 60), *saved(30, 40, epoch=2)], Counted("00000060-e1", 0))
    assert (known, found) == (Counted("00000040-e2", 0), 40)


def test_the_job_has_one_node_like_those_of_the_training_where_the_section_says_nothing_else() -> None:
    spec = automatic_evaluation("ant-1", TRAINED, place_of("slow", EVALUATION, "a"), EVALUATION, 40)
    assert spec.evaluate is not None and spec.evaluate.model_dump(exclude_none=True) == {
        **{"run": "ant-1", "checkpoint": 40, "episodes": 32, "worlds": 16, "config": {}, "keep": False}
    }
    assert (spec.name, spec.queue, spec.share, spec.image) == ("evaluate-ant-1", "slow", "a", "mine")
    assert (spec.nodes.max, spec.resources.gpus, spec.resources.cpus, spec.environment) == (1, 1, 4.0, {"NOTE": "a"})
    assert (spec.priority, spec.preemptible, spec.retry.attempts) == (0, True, 3)
    section = {"every": 1, "queue": "idle", "resources": {"cpus": 0.5, "memory": 512}, "retry": {"attempts": 1}}
    expected = evaluation_settings({**TRAINED, "evaluation": section})
    assert expected is not None
    spec = automatic_evaluation("ant-1", TRAINED, place_of("slow", expected, "a"), expected, 40)
    assert (spec.queue, spec.share, spec.resources.cpus, spec.resources.memory) == ("idle", None, 0.5, 512)
    assert (spec.resources.gpus, spec.retry.attempts) == (0, 1)


def test_the_evaluations_of_a_training_that_accepts_a_changed_robot_accept_it_too() -> None:
    accepting = {**TRAINED, "train": {**TRAINED["train"], "accept_changed_robot": True}}
    for trained, accepts in ((TRAINED, False), (accepting, True)):
        spec = automatic_evaluation("ant-1", trained, place_of("slow", EVALUATION, "a"), EVALUATION, 40)
        assert spec.evaluate is not None and spec.evaluate.accept_changed_robot is accepts


def test_a_spec_of_the_batch_api_is_read_with_care() -> None:
    assert evaluation_settings({"train": "x", "evaluation": {"every": 1}}) is None
    assert (
        evaluation_settings(None)
        is evaluation_settings(TRAINED)
        is evaluation_settings({"command": ["x"], "evaluation": {"every": 1}})
        is None
    )
    with pytest.raises(SpecError, match=r"^evaluation\.every: expected a value greater than or equal to 1, found 0$"):
        evaluation_settings({**TRAINED, "evaluation": {"every": 0}})
