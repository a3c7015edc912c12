"""What a declaration or a job gives a task and can't be: one line each, before any world is built."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.declared import MODEL, Sliders, SlidersConfig, distant, kick, target
from worker.simulation.sensors.height_scan import HeightScan, RingPattern
from worker.tasks import (
    Action,
    Adaptive,
    Command,
    Declaration,
    Event,
    Observation,
    Reward,
    Robot,
    Termination,
    WorldArrays,
    terms,
)


def refused(config: SlidersConfig | None = None, *, beside: Mapping[str, Any] = {}, **changed: Any) -> str:
    """The line with which sliders are refused that have other sections, or further entries in their own."""

    class Wrong(Sliders):
        def sections(self) -> dict[str, Any]:
            own = super().sections()
            return {**own, **changed, **{name: {**own[name], **more} for name, more in beside.items()}}

    return refusal(Wrong.sketch, config or SlidersConfig()).removeprefix("task Wrong: ")


def observed(**options: Any) -> dict[str, Any]:
    return {"observations": {"a": Observation(terms.joint_position, **options)}}


def commanded(**options: Any) -> dict[str, Any]:
    return {"commands": {"target": Command(target, **{"names": ("place",), "place": (-1.0, 1.0), **options})}}


def every(seconds: Any) -> dict[str, Any]:
    return {"events": {"e": Event(kick, speed=1.0, when="interval", seconds=seconds)}, "curricula": {}}


HALF = 'give half the width, 0 or more, or ("normal", '
STEPS = "give whole control steps, from 0 up, or two, the lesser first"
TWO = "expected 2 numbers, found "
CLIP = ".clip: expected the lesser number first, found [1.0, -1.0]"
SECTIONS: Mapping[str, dict[str, Any]] = {
    f"observations.a: noise is ('normal',); {HALF}": observed(noise=("normal",)),
    f"observations.a: noise is ('gauss', 0.1); {HALF}": observed(noise=("gauss", 0.1)),
    f"observations.a: noise is -0.1; {HALF}": observed(noise=-0.1),
    f"observations.a: delay is 1.5; {STEPS}": observed(delay=1.5),
    f"observations.a: delay is (2, 1); {STEPS}": observed(delay=(2, 1)),
    "observations.a: history is 2.0; it counts the present step, so it is 1 or more": observed(history=2.0),
    "observations.a: 1 units for 2 columns; give one for all, or one for each": observed(unit=("m",)),
    f"observations.a{CLIP}": observed(clip=(1.0, -1.0)),
    f"commands.target.seconds: {TWO}'a'": commanded(seconds="a"),
    "commands.target.seconds: expected the least and the greatest time, above 0": commanded(seconds=(0.0, 1.0)),
    "commands.target: 2 units for 1 numbers; give one for each": commanded(units=("m", "s")),
    "commands.target: names are (); name each number that the policy sees": commanded(names=()),
    f"events.e.seconds: {TWO}(2.0,)": every((2.0,)),
    "randomize.m: expected a Randomize, found a str": {"randomize": {"m": "mass"}},
    "sensors.m: expected a sensor, such as ContactSensor(...), found a str": {"sensors": {"m": "mass"}},
}
"""Messages, or their beginnings, by the sections that they refuse."""


@pytest.mark.parametrize("message", SECTIONS)
def test_an_invalid_section_is_refused_with_its_place(message: str) -> None:
    assert refused(**SECTIONS[message]).startswith(message)


@wp.func
def _untyped(world: int, worlds: WorldArrays, joint) -> float:
    return 0.0


@wp.func
def _nothing(world: int, worlds: WorldArrays):
    worlds.joint_q[world, 0] = 0.0


@wp.func
def _vector(world: int) -> wp.vec3:
    return wp.vec3(0.0, 0.0, 0.0)


MISFITS: dict[str, Any] = {
    "rewards.place: _vector must give a float (-> float)": Reward(_vector),
    "rewards.place: _nothing must give a float": Reward(_nothing),
    "rewards.place: _untyped: its parameter joint has no type": Reward(_untyped),
    "rewards.place: 'nothing_alike' is not a function; a term is a": Reward("nothing_alike"),
    "rewards.place: 'joint_speeed' is not a function; did you mean terms.joint_speed?": Reward("joint_speeed"),
    "rewards.place: no joint of robot matches 'third'; available: first, second": Reward(
        terms.joint_position, joints="third"
    ),
    "rewards.place: the task has no robot or object 'cube'; available: robot": Reward(
        terms.joint_position, robot="cube"
    ),
    "rewards.place.limit: expected a number, found (1.0, 2.0)": Reward(terms.joint_velocity_excess, limit=(1.0, 2.0)),
    "rewards.plce: it has no weight; give it one, such as Reward(…, weight=-1.0)": Reward(terms.alive),
    "terminations.typo: distant has no parameter limt; did you mean limit?": Termination(distant, limt=3.0),
    "terminations.out: distant needs limit=float": Termination(distant),
    "terminations.both: distant has no parameter limt; did you mean limit?": Termination(distant, limit=3.0, limt=3.0),
    "terminations.alive: alive has a parameter terminated, which there is nothing for here": Termination(terms.alive),
    "terminations.time_out: the clock's own has this name": Termination(distant, limit=1.0),
    "actions: joint first is driven by two terms": Action(terms.effort),
    "actions.force.scale: no column matches 'frst'; did you mean first?": Action(terms.effort, scale={"frst": 1.0}),
    "actions.force.scale: no pattern fits second; add one, such as '*'": Action(terms.effort, scale={"first": 1.0}),
    "commands.target: distant has a parameter joint, which there is nothing for here": Command(
        distant, names=("a",), limit=1.0
    ),
    "events.kick: an interval needs seconds=(least, greatest), above 0": Event(distant, limit=1.0, when="interval"),
}


@pytest.mark.parametrize("message", MISFITS)
def test_misfits_are_refused_in_one_line(message: str) -> None:
    section, name = (*message.split(":")[0].split("."), "another")[:2]
    assert refused(beside={section: {name: MISFITS[message]}}).startswith(message)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Adaptive("x.y", 0.0, 1.0, above=1.0, below=2.0), "below is 2.0, which must be less than above, 1.0"),
        (
            lambda: Declaration(actions={}, observations={}, rewards={"Place": Reward(terms.alive)}),
            "rewards.Place: a name has small letters, digits and underscores",
        ),
        (
            lambda: Declaration(actions={}, observations={"place": Reward(terms.alive)}, rewards={}),
            "observations.policy.place: expected an Observation, found a Reward",
        ),
        (lambda: Robot(MODEL, position=(0.0, 0.0)), "Robot robot: position is (0.0, 0.0); give 3 finite numbers"),
        (lambda: Robot(MODEL, rotation=(1.0,)), "Robot robot: rotation is (1.0,); give 4 finite numbers"),
    ],
)
def test_a_part_that_is_invalid_by_itself_is_refused_where_it_is_made(make: Callable[[], Any], message: str) -> None:
    assert message in refusal(make)


def test_an_action_on_a_joint_without_an_actuator_is_refused() -> None:
    robot = Robot(MODEL.replace('<motor joint="second" gear="3"/>', ""), passive=True)
    bare = type("Bare", (Sliders,), {"robot": lambda self, config: robot})
    assert "actions.force: joint second has no actuator; give the robot one, or leave" in refusal(
        bare.sketch, SlidersConfig()
    )


SCANNED: Mapping[str, Any] = {
    "sensors": {"scan": HeightScan(bodies=("near", "far"), pattern=RingPattern(radius=0.04, count=4, center=True))},
    "observations": {"a": Observation(terms.frame_clearance, points=5)},
}
NUMBERS: Mapping[str, tuple[Any, str]] = {
    "rewards.plac.x": (1.0, "the task has no number 'rewards.plac.x'; available: "),
    "randomize.mas.range": ([1.0, 2.0], "the task has no number 'randomize.mas.range'; did you mean"),
    "actions.force.scale": (1.0, "expected 2 numbers, found 1.0"),
    "randomize.mass.range": ([-3.0, -2.0], "randomize mass: the range (-3.0, -2.0) would make mass negative"),
    "commands.target.seconds": ([-3.0, -2.0], "expected the least and the greatest time, above 0"),
    "actions.force.clip": ([1.0, -1.0], "expected the lesser number first"),
    "observations.noisy.noise": (-1.0, "expected 0 or more, found [-1.0]"),
    "observations.a.points": (50.0, "the declaration alone can change it from 5"),
}


@pytest.mark.parametrize("place", NUMBERS)
def test_numbers_of_a_job_are_checked_as_those_of_the_declaration(place: str) -> None:
    value, message = NUMBERS[place]
    found = refused(SlidersConfig(numbers={place: value}), **(SCANNED if "points" in place else {}))
    assert found.startswith(
        f"config.numbers: {message}" if "no number" in message else f"config.numbers.{place}: {message}"
    )


def test_a_curriculum_is_checked_when_the_task_is_built() -> None:
    def course(place: str, *values: float) -> str:
        return refused(SlidersConfig(curriculum={place: tuple(enumerate(values))}))

    assert course("rewards.plce.x", 1.0).startswith("config.curriculum: the task has no number 'rewards.plce.x'")
    assert course("events.kick.seconds", 1.0, -1.0).startswith("config.curriculum.events.kick.seconds: expected the")
    assert course("randomize.mass.range", 1.0, -1.0).startswith("config.curriculum.randomize.mass.range: randomize")
    for place, output in (
        ("randomize.mass.range", ".randomize.mass.range: randomize mass"),
        ("events.kik.speed", ": the task has no number 'events.kik.speed'; did you mean events.kick.speed?"),
        ("sped", ": the task has no number 'sped'; did you mean events.kick.speed?"),
        ("alive", ": the task has no number 'alive'; available: actions.force.clip, "),
    ):
        assert refused(curricula={"heavy": Adaptive(place, 1.0, 0.0)}).startswith(f"curricula.heavy{output}")
