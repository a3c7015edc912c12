"""The evaluations of a run: what they are called, which one counts for a checkpoint, which checkpoint is the best and is kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from shared_store.volume import evaluations
from shared_store.volume.checkpoints import best_checkpoint, list_checkpoints, retain
from shared_store.volume.files import write_json
from shared_store.volume.layout import Run, Store
from tests.support.orchestrator.trained import add_checkpoint, add_run

FIGURES: dict[str, Any] = {"mean_length": 9.0, "max_length": 10, "task": "Cartpole", "config": {}}


@pytest.fixture
def run(tmp_path: Path) -> Run:
    store = Store(tmp_path)
    add_run(store, "taught")
    for iteration, score in ((3, 5.0), (6, 9.0), (9, 7.0)):
        add_checkpoint(store, "taught", iteration, score=score)
    return store.run("taught")


def evaluate(run: Run, name: str, mean: float, time: float = 1.0, episodes: int = 100, **facts: Any) -> None:
    found = {**FIGURES, "mean_return": mean, "time": time, "episodes": episodes, **facts}
    write_json(run.evaluations / f"{name}.json", found)


def test_an_evaluation_is_called_after_its_checkpoint_and_its_job() -> None:
    assert evaluations.evaluation_name("00000003-e1") == "00000003-e1"
    assert evaluations.evaluation_name("00000003-e1", "1f2e3d4c-5b6a") == "00000003-e1-1f2e3d4c"
    assert evaluations.evaluation_name("00000003-e1", "1f2e3d4c-5b6a:7") == "00000003-e1-1f2e3d4c-7"
    assert (
        evaluations.checkpoint_of("00000003-e1-1f2e3d4c-7") == evaluations.checkpoint_of("00000003-e1") == "00000003-e1"
    )
    assert evaluations.checkpoint_of("notes") is None and evaluations.checkpoint_of("00000003-e1-../x") is None


def test_evaluations_are_listed_by_time_and_damaged_ones_are_skipped(run: Run) -> None:
    evaluate(run, "00000009-e1", 1.0, time=30.0)
    evaluate(run, "00000003-e1-b", 2.0, time=20.0)
    evaluate(run, "notes", 9.0, time=1.0)
    evaluate(run, "00000006-e1", 3.0, time=1.0, mean_length="long")
    (run.evaluations / "00000006-e1-c.json").write_text("[" * 200)
    found = evaluations.list_evaluations(run)
    assert [(each["name"], each["checkpoint"]) for each in found] == [
        ("00000003-e1-b", "00000003-e1"),
        ("00000009-e1", "00000009-e1"),
    ]


def test_of_a_checkpoint_the_evaluation_of_the_most_episodes_in_its_own_worlds_counts(run: Run) -> None:
    evaluate(run, "00000003-e1-a", 1.0, time=1.0, episodes=500)
    evaluate(run, "00000003-e1-b", 2.0, time=2.0, episodes=100)
    evaluate(run, "00000003-e1-c", 3.0, time=3.0, episodes=900, config={"randomize": {"friction": [0.5, 0.5]}})
    assert evaluations.by_checkpoint(run)["00000003-e1"]["mean_return"] == 1.0
    evaluate(run, "00000003-e1-d", 4.0, time=4.0, episodes=500)
    assert evaluations.by_checkpoint(run)["00000003-e1"]["mean_return"] == 4.0


def test_the_best_checkpoint_is_that_of_two_evaluated_ones_and_else_that_of_the_greatest_score(run: Run) -> None:
    def best() -> int:
        found = best_checkpoint(run)
        assert found is not None
        return found.iteration

    assert best() == 6
    evaluate(run, "00000009-e1", 100.0)
    assert best() == 6, "the last one alone would be the best of one"
    evaluate(run, "00000003-e1-a", 200.0, config={"level": 1})
    assert best() == 6, "in other worlds"
    evaluate(run, "00000003-e1-b", 99.0)
    assert best() == 9
    evaluate(run, "00000003-e1-c", 100.0, episodes=200)
    assert best() == 9, "of equals the later one"
    evaluate(run, "00000003-e1-d", 101.0, episodes=300)
    assert best() == 3


def test_retention_keeps_of_evaluations_that_keep_nothing_the_best_and_what_is_still_to_be_evaluated(run: Run) -> None:
    store = Store(run.path.parent.parent)
    add_checkpoint(store, "taught", 12)
    evaluate(run, "00000003-e1-1f2e3d4c", 7.0, keep=False)
    evaluate(run, "00000009-e1-1f2e3d4c", 5.0, keep=False)
    evaluations.keep_for_evaluation(run, "00000009-e1")
    add_checkpoint(store, "taught", 15)
    assert retain(run, keep=1) == ["00000012-e1"]
    evaluations.keep_for_evaluation(run, "00000015-e1")
    assert retain(run, keep=1) == ["00000009-e1"], "one waits at a time"
    evaluations.release_from_evaluation(run, "00000015-e1")
    evaluate(run, "00000015-e1-1f2e3d4c", 8.0, keep=False)
    assert retain(run, keep=1) == ["00000003-e1"], "there is a better one"
    assert [each.iteration for each in list_checkpoints(run)] == [6, 15], "of the greatest score, the newest"


def test_one_line_tells_the_successes_of_a_task_that_declares_them_and_else_how_long_episodes_lasted() -> None:
    found: dict[str, Any] = {**FIGURES, "mean_return": 96.5, "episodes": 64}
    lasted = "mean episode length 9.0 of 10 (90 %), mean return 96.50 over 64 episodes"
    share = {"count": 62, "share": 62 / 64, "low": 0.9, "high": 1.0}
    assert (
        evaluations.in_one_line(found)
        == evaluations.in_one_line({**found, "success": None, "success_is": None})
        == lasted
    )
    assert evaluations.in_one_line({**found, "success": share, "success_is": "the clock ended the episode"}) == lasted
    laps = {"success": share, "success_is": "lap_complete ended the episode", "shown": {"progress": "98.1 %"}}
    assert evaluations.in_one_line({**found, **laps}) == (
        "62 of 64 episodes succeeded (96.9 %: lap_complete ended the episode), progress 98.1 %, mean length 9.0 steps, mean return 96.50"
    )


def test_a_summary_is_printed_with_what_any_job_may_have_left_out_of_it() -> None:
    few = {**FIGURES, "checkpoint": "00000003-e1", "episodes": 3, "success": 7, "causes": {"fall": 2}}
    result = "\n".join(evaluations.lines(few))
    assert "3 episodes of Cartpole, checkpoint 00000003-e1" in result and "success" not in result
    config = {"randomize": {"friction": [0.4, 0.6]}, "curriculum": {}}
    share = {"share": 0.94, "low": 0.875, "high": 0.972}
    whole = {**few, "episodes": 100, "config": config, "success": share, "success_is": "it stands"}
    result = "\n".join(evaluations.lines({**FIGURES, **whole}))
    assert "with config.randomize.friction: [0.4, 0.6]" in result and "config.curriculum: {}" in result
    assert " ".join(result.split()).count("success 94.0 % 87.5 % to 97.2 % it stands") == 1
    term = {"mean": 1.0, "low": 0.5, "high": 1.5, "std": 0.1}
    rows = list(
        evaluations.lines({**FIGURES, **whole, "rewards": {"track_angular_velocity": term}, "metrics": {"way": term}})
    )
    heading = next(row for row in rows if row.endswith("std"))
    columns = {len(row) for row in rows if row.startswith(("reward", "metric", "return"))}
    assert columns == {len(heading)}, "they stand"
