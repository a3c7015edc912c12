"""A task with other parts: `with_`, weights beside terms, and drafts in torch, which compile nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import warp as wp
from warp._src.context import Module

from tests.support.refusals import refusal
from tests.support.worker.tasks import observe, play, put, statistics
from worker.learning.job import configure
from worker.settings.errors import UserError
from worker.settings.ppo import PPOConfig
from worker.tasks import (
    Action,
    Choice,
    ContactSensor,
    Event,
    Metric,
    Observation,
    Randomize,
    Reward,
    Termination,
    find_task,
    terms,
)
from worker.tasks.library.cartpole import Cartpole
from worker.tasks.run.task import Task


def tilt(task: Task, joints: torch.Tensor, scale: float = 1.0) -> torch.Tensor:
    """The angle of the chosen joint, shape (worlds,)."""
    angles: torch.Tensor = wp.to_torch(task.worlds.arrays.joint_q)[:, joints]
    return scale * angles.sum(-1)


def leans(task: Task) -> torch.Tensor:
    """Whether the pole leans to the right by more than 0.3 rad."""
    angles: torch.Tensor = wp.to_torch(task.worlds.arrays.joint_q)
    return angles[:, 1] > 0.3


def names(task: Task) -> dict[str, Any]:
    found = task.declaration
    return {"rewards": [*found.rewards], "events": [*found.events], "observations": [*found.groups["policy"]]}


def test_parts_are_added_replaced_and_removed() -> None:
    mine = Cartpole.with_(
        rewards={
            "tilt": Reward(tilt, weight=-0.5, joints="hinge"),
            "effort": None,
            "alive": Reward(terms.alive, weight=2.0),
        },
        observations={
            "policy": {"velocity": None, "power": Observation(terms.joint_power, joints="slider")},
            "critic": {},
        },
        terminations={"dropped_pole": None},
        metrics={"speed": Metric(terms.joint_speed)},
        events={"later": Event(terms.reset_to_default)},
        randomize={"mass": Randomize("mass", bodies="*", range=(0.5, 2.0))},
        success="speed",
        config={"episode_seconds": 2.0, "ppo": {"steps": 9}},
    )
    assert issubclass(mine, Cartpole) and mine.__module__ == __name__ and mine.config_type is not Cartpole.config_type
    config = mine.config_type()
    assert (config.episode_seconds, config.ppo.steps, config.ppo.hidden_sizes) == (2.0, 9, (32, 32))
    with pytest.raises(ValueError, match=r"critic: the group has no terms"):
        mine.sketch(config)
    task = mine.with_(observations={"critic": None}).sketch(config)
    assert names(task) == {
        "rewards": ["alive", "angle", "position", "velocity", "fall", "tilt"],
        "events": ["place", "later"],
        "observations": ["position", "power"],
    }
    assert task.config.rewards["tilt"] == -0.5 and task.config.rewards["alive"] == 2.0
    assert task.config.rewards["fall"] == -2.0 and task.termination_names == (
        "termination_left_rail",
        "termination_time_out",
    )
    assert Cartpole.config_type().rewards["alive"] == 0.1, "the shipped task is as it was"
    again = mine.with_(rewards={"tilt": Reward(tilt, joints="slider")}, observations={"critic": None}).sketch(config)
    assert again.plan.weights["tilt"] == -0.5, "a term in place of another keeps its weight"
    other = Cartpole.with_(actions={"force": Action(terms.effort, joints="slider", scale=0.5)}).sketch(
        Cartpole.config_type()
    )
    assert other.plan.numbers.values[other.plan.numbers.places["actions.force.scale"][0]] == 0.5


def test_a_yaml_overrides_the_weight_beside_a_term() -> None:
    mine = Cartpole.with_(rewards={"tilt": Reward(tilt, weight=-0.5, joints="hinge")})
    config = configure(mine, {"config": {"rewards": {"tilt": -2, "fall": -4}, "curriculum": {"tilt": [[0, 1.0]]}}})
    task = mine.sketch(config)
    assert task.plan.weights["tilt"] == -2.0 and task.plan.weights["fall"] == -4.0
    assert task.reward_terms[-1] == "tilt", "the order does not depend on what a job names"
    wrong = configure(mine, {"config": {"rewards": {"tlt": 1}}})
    assert refusal(mine.sketch, wrong) == "config.rewards.tlt: the task has no term 'tlt'; did you mean tilt?"
    wrong = configure(mine, {"config": {"curriculum": {"titl": [[0, 1]]}}})
    assert refusal(mine.sketch, wrong) == "config.curriculum.titl: there is no such term; did you mean tilt?"


REFUSED: dict[str, dict[str, Any]] = {
    "Cartpole.with_: a declaration has no part reward; did you mean rewards?": {"reward": {}},
    "Cartpole.with_: rewards is a Reward; give parts by name, such as rewards={'name': …}": {"rewards": Reward(tilt)},
    "Cartpole.with_: observations.x is an Observation; observations are by group,": {
        "observations": {"x": Observation(tilt)}
    },
    "task Cartpole: config.episode_second: CartpoleConfig has no such key; did": {"config": {"episode_second": 1}},
    "task Cartpole: config.substeps: expected a value greater than or equal to 1": {"config": {"substeps": 0}},
    "task Cartpole: rewards.efort: there is nothing of this name to remove; did you mean effort?": {
        "rewards": {"efort": None}
    },
    "task Cartpole: rewards.tilt: it has no weight; give it one, such as Reward(…, we": {
        "rewards": {"tilt": Reward(tilt)}
    },
    "task Cartpole: rewards.tilt.weight: expected a number, found": {
        "rewards": {"tilt": Reward(tilt, weight="much")}  # type: ignore[arg-type]
    },
    "task Cartpole: rewards.tilt: expected a Reward, found a Metric": {"rewards": {"tilt": Metric(tilt)}},
    "task Cartpole: metrics.tilt: tilt: got an unexpected keyword argument 'scal'": {
        "metrics": {"tilt": Metric(tilt, scal=2.0)}
    },
    "task Cartpole: metrics.tilt: no joint of robot matches 'hing'": {"metrics": {"tilt": Metric(tilt, joints="hing")}},
    "task Cartpole: metrics.tilt: tilt has no parameter bodies; leave": {"metrics": {"tilt": Metric(tilt, bodies="*")}},
    "task Cartpole: sensors.feet: ": {"sensors": {"feet": ContactSensor}},
    "task Cartpole: success: no metric and no termination is called tlt": {"success": "tlt"},
}


@pytest.mark.parametrize("message", REFUSED)
def test_an_unknown_or_malformed_part_is_refused_in_one_line(message: str) -> None:
    def sketch() -> Task:
        mine = Cartpole.with_(**REFUSED[message])
        return mine.sketch(mine.config_type())

    assert refusal(sketch).startswith(message)


def test_a_job_finds_it_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (
        "from worker.tasks import Reward, terms\nfrom worker.tasks.library.cartpole import Cartpole\n"
        "Calm = Cartpole.with_({}={{'calm': Reward(terms.joint_speed, weight=-0.1)}})\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    for name, part in (("calm_poles", "rewards"), ("wrong_poles", "rewrds")):
        (tmp_path / f"{name}.py").write_text(text.format(part))
    found = find_task("calm_poles:Calm")
    assert (found.__name__, found.__module__) == ("Calm", "calm_poles")
    assert found.sketch(found.config_type()).reward_terms[-1] == "calm"
    wrong = r"^task wrong_poles:Calm: \S*poles.py:3: Cartpole.with_: a declaration has no part rewrds; did"
    with pytest.raises(ValueError, match=wrong):
        find_task("wrong_poles:Calm")


@pytest.fixture
def compilations(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the modules that Warp compiles or loads from now on."""
    found: list[str] = []
    load = Module.load

    def loaded(self: Module, *arguments: Any, **options: Any) -> Any:
        if not self.execs:
            found.append(self.name)
        return load(self, *arguments, **options)

    monkeypatch.setattr(Module, "load", loaded)
    return found


def drafted(change: Callable[[Task], torch.Tensor]) -> type[Cartpole]:
    return Cartpole.with_(
        rewards={"tilt": Reward(change, weight=-0.5, per_second=True)},
        metrics={"draft": Metric(change, at_end=True)},
        terminations={
            "leans": Termination(leans),
            "late": Termination(lambda task: task.episode_length < 0, time_out=True),
        },
        success="leans",
    )


def test_a_draft_in_torch_compiles_nothing_and_counts_as_any_term(compilations: list[str]) -> None:
    shipped = Cartpole(Cartpole.config_type(), 4, seed=1)
    shipped.worlds.update_bodies()  # Newton's, as a view or a recording does
    compilations.clear()
    for factor in (1.0, 3.0):  # and the second version neither

        def lean(task: Task, factor: float = factor) -> torch.Tensor:
            angles: torch.Tensor = wp.to_torch(task.worlds.arrays.joint_q)
            return factor * angles[:, 1:2]

        kind = drafted(lean)
        task = kind(kind.config_type(), 4, seed=1)
        assert task._control.kernels.source == shipped._control.kernels.source and compilations == []
        put(task, joint_q=[[0.0, 0.2], [0.0, 0.35]], joint_qd=[[0.0, 0.0], [0.0, 0.0]])
        task.actions.zero_()
        observe(task)
        plain = Cartpole(Cartpole.config_type(), 4, seed=1)
        put(plain, joint_q=[[0.0, 0.2], [0.0, 0.35]], joint_qd=[[0.0, 0.0], [0.0, 0.0]])
        plain.actions.zero_()
        observe(plain)
        added = (task.rewards - plain.rewards).tolist()
        assert added[0] == pytest.approx(-0.5 * factor * 0.2 / 60.0, rel=1e-4)
        assert task.dones[:2].tolist() == [False, True] and not plain.dones[1]
        assert task.ended.names[int(task.ended.causes[1])] == "leans" and bool(task.ended.judged[1])
        found = statistics(task)
        assert found["termination_leans"] == 1 and found["termination_time_out"] == found["termination_late"] == 0
        assert found["metric_draft"] == pytest.approx(0.35 * factor) and task.terminal_observations[
            1, 1
        ] == pytest.approx(0.35)
        play(task, 20, seed=1)
    assert compilations == []


def test_the_first_of_several_ends_is_the_cause_whatever_they_are_written_in() -> None:
    first = Cartpole.with_(terminations={"left_rail": Termination(leans)})
    task = first(first.config_type(), 2, seed=1)
    put(task, joint_q=[[0.0, 0.5], [0.0, 0.0]])
    observe(task)
    assert task.ended.names[int(task.ended.causes[0])] == "left_rail", (
        "the pole is dropped, too, which is declared after it"
    )
    assert statistics(task)["termination_dropped_pole"] == statistics(task)["termination_left_rail"] == 1


def test_settings_of_a_class_stand_beside_it() -> None:
    class Longer(Cartpole, config={"episode_seconds": 9, "ppo": PPOConfig(steps=7)}):
        pass

    assert (Longer.config_type().episode_seconds, Longer.config_type().ppo.steps) == (9.0, 7)
    assert configure(Longer, {"config": {"episode_seconds": 4}}).cart_limit == 2.4
    assert refusal(configure, Longer, {"config": {"cart_limt": 1}}, error=UserError).endswith(
        "did you mean cart_limit?"
    )


def test_a_choice_may_take_the_place_of_a_section() -> None:
    @wp.func
    def nothing(world: int, choice: int):
        pass

    mine = Cartpole.with_(actions=Choice(nothing, names=["none"]), rewards={"effort": None})
    assert mine.sketch(mine.config_type()).action_names == ("none",)
