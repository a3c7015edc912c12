"""Evaluations: what is recorded of each episode, whatever the batches; intervals and comparisons by hand."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet
import pytest
import torch

from shared_store.volume.evaluations import lines
from shared_store.volume.files import write_json
from shared_store.volume.layout import Run, Store
from shared_store.volume.paired_episodes import are_paired, paired
from tests.support.orchestrator.trained import add_checkpoint, add_run
from tests.support.worker.loop import alone
from worker.evaluation.episodes import Episodes, play
from worker.evaluation.evaluation import best_line, result_of, write_table
from worker.evaluation.statistics import Sample, difference, share
from worker.settings.cartpole import CartpoleConfig
from worker.tasks import terms
from worker.tasks.declare.declaration import Declaration, Metric
from worker.tasks.library.cartpole import Cartpole

GANG = alone()


class Push:
    """A policy that pushes the cart in the direction in which it finds the pole, so hard that it mostly falls on the other side."""

    def __init__(self, strength: float = 1.0) -> None:
        self.strength, self.resets = strength, 0

    def act(self, observations: Any) -> torch.Tensor:
        return (observations["policy"][:, 1:2] * 20.0).clamp(-1.0, 1.0) * self.strength

    def reset(self, worlds: torch.Tensor | None = None) -> None:
        self.resets += worlds is None


def config(**fields: Any) -> CartpoleConfig:
    return CartpoleConfig(episode_seconds=1.0, **fields)


@pytest.fixture(scope="module")
def task() -> Cartpole:
    """Six worlds whose poles are upright, but for those that start far to a side."""
    return Cartpole(config(angle_limit=0.12, start_angle=0.15), 6, seed=3)


def by_hand(task: Cartpole, policy: Push) -> list[dict[str, float]]:
    """Return, length and sum of the term `alive` of each world's first episode, from the rewards and observations alone."""
    task.restart(3, 0)
    task.reset()
    found = [{"return": 0.0, "length": 0, "over": False} for _ in range(6)]
    for _ in range(60):
        task.step(policy.act(task.groups))
        for world, row in enumerate(found):
            if not row["over"]:
                row["return"] += float(task.rewards[world])
                row["length"] += 1
                row["over"] = bool(task.dones[world])
                row["time_out"] = bool(task.time_outs[world])
    return found


def test_each_episode_has_its_return_length_terms_cause_and_success(task: Cartpole) -> None:
    expected = by_hand(task, Push())
    task.restart(3, 0)
    played = play([task], Push(), GANG)
    assert played.lengths.tolist() == [row["length"] for row in expected]
    assert played.returns.tolist() == pytest.approx([row["return"] for row in expected], abs=1e-5)
    assert played.time_outs.tolist() == [row["time_out"] for row in expected]
    assert played.ends == ["time_out" if row["time_out"] else "dropped_pole" for row in expected]
    assert set(played.ends) == {"time_out", "dropped_pole"}, "the starts are chosen so that both happen"
    assert played.successes is not None and played.successes.tolist() == [row["time_out"] for row in expected]
    # 0.1 for each step that did not end by a termination; -2 for one that did
    alive = [0.1 * (row["length"] - (not row["time_out"])) for row in expected]
    assert played.term("reward_alive").tolist() == pytest.approx(alive, abs=1e-5)
    assert played.term("reward_fall").tolist() == [0.0 if row["time_out"] else -2.0 for row in expected]
    terms = sum(played.term(name) for name in played.terms)
    assert torch.allclose(terms, played.returns, atol=1e-5), "the weighted terms of a return make it"


class Judged(Cartpole):
    """A cart-pole that says what a success is."""

    says: str | None = None

    def declare(self, config: CartpoleConfig) -> Declaration:
        metrics = {"speed": Metric(terms.joint_velocity_squared, joints="slider")}
        return replace(super().declare(config), metrics=metrics, success=self.says)


def judged(says: str) -> type[Judged]:
    return type("Judged", (Judged,), {"says": says})


def test_a_success_is_a_metric_above_0_in_the_last_step_or_a_termination(task: Cartpole) -> None:
    moving = play([judged("speed")(task.config, 6, seed=3)], Push(), GANG)
    assert moving.success == "speed above 0 in the last step"
    assert moving.successes is not None and moving.successes.all()
    fallen = play([judged("dropped_pole")(task.config, 6, seed=3)], Push(), GANG)
    assert fallen.successes is not None and fallen.success == "dropped_pole ended the episode"
    assert fallen.successes.tolist() == [end == "dropped_pole" for end in fallen.ends]
    # of a metric the table has its mean over the steps
    other = judged("speed")(task.config, 6, seed=3)
    other.reset()
    total, length = 0.0, int(moving.lengths[0])
    for _ in range(length):
        other.step(Push().act(other.groups))
        total += float(other.ended.sums[0, -1]) if other.dones[0] else 0.0
    assert float(moving.term("metric_speed")[0]) == pytest.approx(total / length, rel=1e-5)


@pytest.fixture(scope="module")
def played(task: Cartpole) -> Episodes:
    task.restart(3, 0)
    return play([task], Push(), GANG)


def test_the_table_has_a_row_an_episode_and_the_same_episodes_are_the_same_bytes(
    played: Episodes, tmp_path: Path
) -> None:
    write_table(tmp_path / "one.parquet", played, 7, {"run": "taught"})
    write_table(tmp_path / "two.parquet", played, 7, {"run": "taught"})
    assert (tmp_path / "one.parquet").read_bytes() == (tmp_path / "two.parquet").read_bytes()
    table = pyarrow.parquet.read_table(tmp_path / "one.parquet").to_pydict()
    assert list(table)[:6] == ["episode", "seed", "return", "length", "success", "cause"]
    assert table["episode"] == [0, 1, 2, 3, 4, 5] and table["seed"] == [7] * 6 and table["cause"] == played.ends
    assert table["return"] == played.returns.tolist() and table["reward_fall"] == played.term("reward_fall").tolist()


def test_a_summary_follows_its_table_and_is_compared_with_the_one_before(
    task: Cartpole, played: Episodes, tmp_path: Path
) -> None:
    run = Run(tmp_path / "run")
    run.path.mkdir()
    first = result_of(task, played, "00000003-e1", 7, 0.0).write(run, "first-job", config={})
    assert "compared" not in first and first["table"] == "00000003-e1-first-jo.parquet"
    fell = played.ends.count("dropped_pole")
    assert first["causes"]["dropped_pole"]["count"] == fell and first["success"]["count"] == 6 - fell
    falls = first["rewards"]["fall"]
    assert falls["mean"] == pytest.approx(-2.0 * fell / 6) and falls["weight"] == -2.0
    second = result_of(task, played, "00000006-e1", 7, 0.0).write(run, "second-job", config={"angle_limit": 0.3})
    assert second["compared"]["checkpoint"] == "00000003-e1" and second["compared"]["other_worlds"]
    compared = second["compared"]["return"]
    assert compared["difference"] == 0.0 and compared["verdict"] == "within noise"
    assert "method" not in compared, "the worlds are others"
    third = result_of(task, played, "00000009-e1", 7, 0.0).write(run, "third-job", config={"angle_limit": 0.3})
    same = {"difference": 0.0, "low": 0.0, "high": 0.0, "verdict": "within noise", "method": "paired", "pairs": 6}
    assert third["compared"]["return"] == same
    last = list(lines(json.loads(json.dumps(third))))[-1]
    assert last.endswith(": return +0.00 (+0.00 to +0.00, paired over 6 episodes): within noise"), last
    (run.evaluations / third["table"]).unlink()
    fourth = result_of(task, played, "00000012-e1", 7, 0.0).write(run, "fourth-job", config={"angle_limit": 0.3})
    assert fourth["compared"]["name"] == "00000009-e1-third-jo" and "method" not in fourth["compared"]["return"]
    assert json.loads((run.evaluations / "00000006-e1-second-j.json").read_text()) == json.loads(json.dumps(second))


def test_returns_of_other_rewards_are_not_compared(task: Cartpole, played: Episodes, tmp_path: Path) -> None:
    run, function = Run(tmp_path / "run"), {"reward_function": {"file": "mine.py", "text": "one\ntwo\n"}}
    run.path.mkdir()
    result_of(task, played, "00000003-e1", 7, 0.0).write(run, "own-job", config={})
    heavier = replace(result_of(task, played, "00000003-e1", 7, 0.0), weights={**task.config.rewards, "fall": -4.0})
    assert "compared" not in heavier.write(run, "heavier", config={"rewards": {"fall": -4.0}})
    other = result_of(task, played, "00000003-e1", 7, 0.0).write(run, "function", config=function)
    assert "compared" not in other
    assert "  with config.reward_function.text: 2 lines" in list(lines(other)), "and not the lines themselves"
    again = result_of(task, played, "00000006-e1", 7, 0.0).write(run, "again", config={})
    assert again["compared"]["name"] == "00000003-e1-own-job"


def test_an_evaluation_is_compared_with_the_newest_in_the_same_episodes(
    task: Cartpole, played: Episodes, tmp_path: Path
) -> None:
    run = Run(tmp_path / "taught")
    run.path.mkdir()
    summary: dict[str, Any] = {}
    for job, iteration, seed in (("one", 20, 7), ("two", 20, 9), ("three", 40, 7), ("four", 40, 7)):
        summary = result_of(task, played, f"{iteration:08d}-e1", seed, 0.0).write(run, job, config={})
    compared = summary["compared"]
    assert compared["name"] == "00000020-e1-one" and compared["return"]["method"] == "paired"
    summary = result_of(task, played, "00000040-e1", 11, 0.0).write(run, "five", config={})
    assert summary["compared"]["name"] == "00000040-e1-four", "without a partner, with the newest"


def test_a_killed_evaluation_leaves_no_partial_table_and_the_next_one_deletes_its_leftovers(
    task: Cartpole, played: Episodes, tmp_path: Path
) -> None:
    run = Run(tmp_path / "run")
    run.path.mkdir()
    run.evaluations.mkdir(parents=True)
    half = run.evaluations / ".00000003-e1-job.parquet.0123abcd.tmp"
    half.write_bytes(b"PAR1")
    pid = os.fork()
    if pid == 0:  # killed between the table and the summary
        write_table(run.evaluations / "00000003-e1-job.parquet", played, 7, {})
        os._exit(9)
    os.waitpid(pid, 0)
    assert not half.exists() and list(run.evaluations.glob("*.json")) == []
    result_of(task, played, "00000003-e1", 7, 0.0).write(run, "job", config={})
    left = sorted(path.name for path in run.evaluations.iterdir())
    assert left == ["00000003-e1-job.json", "00000003-e1-job.parquet"]


def test_the_end_of_a_training_names_the_best_checkpoint_once_there_is_one_to_compare_it_with(tmp_path: Path) -> None:
    store = Store(tmp_path)
    add_run(store, "taught")
    run, figures = store.run("taught"), {"mean_length": 9.0, "max_length": 10, "episodes": 4, "time": 1.0}
    for iteration, mean in ((3, 7.25), (6, 5.0)):
        assert best_line(run) == ""
        name = add_checkpoint(store, "taught", iteration).name
        write_json(run.evaluations / f"{name}.json", {**figures, "mean_return": mean})
    assert best_line(run) == f"best of 2 checkpoints that are evaluated: {run.name}@3, mean return 7.25"


def test_the_interval_of_a_mean_is_student_s() -> None:
    found = Sample.of(torch.tensor([2.0, 4.0, 4.0, 6.0], dtype=torch.float64)).describe()
    # t of 3 degrees of freedom; squares of deviations 8, n - 1 = 3, root of n = 2
    half = 3.182446305 * math.sqrt(8 / 3) / 2
    assert found["mean"] == 4.0 and found["std"] == pytest.approx(math.sqrt(8 / 3))
    assert (found["low"], found["high"]) == (pytest.approx(4.0 - half), pytest.approx(4.0 + half))
    assert Sample.of(torch.tensor([3.0])).describe() == {"mean": 3.0, "std": None, "low": None, "high": None}


@pytest.mark.parametrize(
    ("hits", "count", "low", "high"),
    # Newcombe (1998), Two-sided confidence intervals for the single proportion, table I, method 3
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_the_interval_of_a_share_is_wilson_s(hits: int, count: int, low: float, high: float) -> None:
    found = share(hits, count)
    assert (found["low"], found["high"]) == (pytest.approx(low, abs=5e-5), pytest.approx(high, abs=5e-5))
    assert share(count, count)["high"] == 1.0 and share(count, count)["low"] < 1.0


def test_a_difference_is_welch_s() -> None:
    new, old = Sample(10, 20.0, 4.0), Sample(40, 15.0, 2.0)
    parts = 16 / 10, 4 / 40
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / 9 + parts[1] ** 2 / 39)
    assert freedom == pytest.approx(10.15, abs=0.01)
    half = 2.2239 * math.sqrt(sum(parts))  # t of so many degrees of freedom
    found = difference(new, old)
    assert found["difference"] == 5.0 and found["verdict"] == "better"
    assert (found["low"], found["high"]) == (pytest.approx(5 - half, abs=1e-3), pytest.approx(5 + half, abs=1e-3))
    assert difference(old, new)["verdict"] == "worse"
    assert difference(Sample(10, 16.0, 4.0), old)["verdict"] == "within noise"
    # samples without spread are distinguished unless they are equal
    assert difference(Sample(9, 2.0, 0.0), Sample(9, 1.0, 0.0))["verdict"] == "better"
    assert difference(Sample(9, 1.0, 0.0), Sample(9, 1.0, 0.0))["verdict"] == "within noise"
    assert difference(Sample(1, 2.0, 0.0), Sample(9, 1.0, 1.0))["verdict"] == "unknown"


def test_the_interval_of_paired_differences_is_student_s() -> None:
    """Student (1908), table of the Cushny and Peebles data: additional hours of sleep by two drugs, ten patients."""
    first = [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0]
    second = [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4]
    found = paired(second, [*first, 1e9])
    half = 2.262157163 * 1.229995484 / math.sqrt(10)  # t of 9 degrees of freedom; s of the differences
    assert found["difference"] == pytest.approx(1.58) and found["pairs"] == 10 and found["method"] == "paired"
    assert (found["low"], found["high"]) == (pytest.approx(1.58 - half), pytest.approx(1.58 + half))
    assert found["verdict"] == "better" and paired(first, second)["verdict"] == "worse"
    apart = difference(Sample.of(torch.tensor(second)), Sample.of(torch.tensor(first)))
    assert apart["verdict"] == "within noise", "what pairs tell apart, samples do not"
    assert paired([2.0], [1.0])["verdict"] == "unknown" and paired(first, first)["verdict"] == "within noise"


def test_episodes_are_paired_where_seed_task_and_changes_of_the_worlds_are_the_same() -> None:
    one = {"seed": 7, "task": "Cartpole", "config": {}}
    assert are_paired(one, {**one, "config": None, "episodes": 9})
    for other in ({"seed": 8}, {"task": "Ant"}, {"config": {"angle_limit": 0.3}}):
        assert not are_paired(one, {**one, **other})
    of_a_training = {**one, "seed": None}
    assert not are_paired({**one, "seed": 0}, of_a_training) and not are_paired(of_a_training, {**one, "seed": 0})
    assert not are_paired(of_a_training, of_a_training), "the ends of two trainings: each in its own worlds"
