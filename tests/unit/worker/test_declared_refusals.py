"""What a declaration or a job gives a task and can't be: one line each, before any world is built."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.declared import MODEL, Sliders, SlidersConfig, distant, kick, target
from worker.simulation.declared_randomization import Randomize
from worker.simulation.sensors.height_scan import HeightScan, RingPattern
from worker.simulation.terrain import Terrain
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


def drawn(quantity: str, **options: Any) -> dict[str, Any]:
    return {"randomize": {"f": Randomize(quantity, **{"range": (0.5, 1.0), **options})}}


HALF = 'give half the width, 0 or more, or ("normal", '
STEPS = "give whole control steps, from 0 up, or two, the lesser first"
TWO = "expected 2 numbers, found "
CLIP = ".clip: expected the lesser number first, found [1.0, -1.0]"
SECTIONS: Mapping[str, dict[str, Any]] = {
    f"observations.a: noise is ('normal',); {HALF}": observed(noise=("normal",)),
    f"observations.a: noise is {{'*': 0.1}}; {HALF}": observed(noise={"*": 0.1}),
    f"observations.a: noise is ('gauss', 0.1); {HALF}": observed(noise=("gauss", 0.1)),
    f"observations.a: noise is -0.1; {HALF}": observed(noise=-0.1),
    f"observations.a: delay is 1.5; {STEPS}": observed(delay=1.5),
    f"observations.a: delay is (1,); {STEPS}": observed(delay=(1,)),
    f"observations.a: delay is (2, 1); {STEPS}": observed(delay=(2, 1)),
    "observations.a: history is 2.0; it counts the present step, so it is 1 or more": observed(history=2.0),
    "observations.a: 1 units for 2 columns; give one for all, or one for each": observed(unit=("m",)),
    "observations.a: memory is -2; give a whole number from 0 up": observed(memory=-2),
    f"observations.a{CLIP}": observed(clip=(1.0, -1.0)),
    f"actions.force{CLIP}": {"actions": {"force": Action(terms.effort, clip=(1.0, -1.0))}},
    f"commands.target.seconds: {TWO}'a'": commanded(seconds="a"),
    "commands.target.seconds: expected the least and the greatest time, above 0": commanded(seconds=(0.0, 1.0)),
    "commands.target: 2 units for 1 numbers; give one for each": commanded(units=("m", "s")),
    "commands.target: names are (); name each number that the policy sees": commanded(names=()),
    "commands.target: names are (3,); name each number that the policy sees": commanded(names=3),
    "commands.target: hidden is -1; give how many numbers, from 0 up": commanded(hidden=-1),
    f"events.e.seconds: {TWO}2.0": every(2.0),
    f"events.e.seconds: {TWO}(2.0,)": every((2.0,)),
    "randomize.m: expected a Randomize, found a str": {"randomize": {"m": "mass"}},
    "sensors.m: expected a sensor, such as ContactSensor(...), found a str": {"sensors": {"m": "mass"}},
    "randomize.f: no body of robot matches 'nar'; did you mean near? there are near, far": drawn("mass", bodies="nar"),
    "randomize.f: no joint of robot matches 'third*'; ": drawn("encoder_bias", joints="third*", range=(0.0, 0.1)),
    "randomize.f: no joint of robot matches 'frst'; did you mean": drawn("stiffness", actuators="frst"),
    "randomize.f: no geom of robot matches 'foot'; ": drawn("friction", geoms=("*", "foot")),
    "randomize.f: no robot or object is called 'robt'; did you": drawn("mass", bodies="*", robot="robt"),
}
"""What is said, or its beginning, of these sections."""


@pytest.mark.parametrize("message", SECTIONS)
def test_a_section_that_cannot_be_is_refused_with_its_place(message: str) -> None:
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
    "rewards.place: 'nothing_alike' is no function; a term is a": Reward("nothing_alike"),
    "rewards.place: 'joint_speeed' is no function; did you mean terms.joint_speed?": Reward("joint_speeed"),
    "rewards.place: no joint of robot matches 'third'; there are first, second": Reward(
        terms.joint_position, joints="third"
    ),
    "rewards.place: the task has no robot or object 'cube'; there are robot": Reward(
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


def test_other_refusals() -> None:
    with pytest.raises(ValueError, match=r"below is 2.0, which must be less than above, 1.0"):
        Adaptive("events.kick.speed", 0.0, 1.0, above=1.0, below=2.0)
    with pytest.raises(ValueError, match=r"config.numbers: the task has no number 'rewards.plac.x'; did you mean"):
        Sliders.sketch(SlidersConfig(numbers={"rewards.plac.x": 1.0}))
    with pytest.raises(ValueError, match=r"config.numbers.actions.force.scale: expected 2 numbers, found 1.0"):
        Sliders.sketch(SlidersConfig(numbers={"actions.force.scale": 1.0}))
    with pytest.raises(ValueError, match=r"rewards.Place: a name has small letters, digits and underscores"):
        Declaration(actions={}, observations={}, rewards={"Place": Reward(terms.alive)})
    with pytest.raises(ValueError, match=r"observations.policy.place: expected an Observation, found a Reward"):
        Declaration(actions={}, observations={"place": Reward(terms.alive)}, rewards={})

    class Bare(Sliders):
        def robot(self, config: SlidersConfig) -> Robot:
            return Robot(MODEL.replace('<motor joint="second" gear="3"/>', ""), passive=True)

    with pytest.raises(ValueError, match=r"actions.force: joint second has no actuator; give the robot one, or leave"):
        Bare.sketch(SlidersConfig())


def test_what_belongs_to_no_robot_is_looked_for_in_the_worlds() -> None:
    class Grounded(Sliders):
        def sections(self) -> dict[str, Any]:
            ground = Randomize("friction", geoms="ground*", range=(0.5, 1.0), robot=None)
            return {**super().sections(), "randomize": {"ground": ground, "g": Randomize("gravity", range=(0.9, 1.1))}}

    assert [*Grounded.sketch(SlidersConfig()).declaration.randomize] == ["ground", "g"]


def test_a_terrain_that_no_machine_can_hold() -> None:
    class Fine(Sliders):
        resolution = 0.0005

        def terrain(self, config: SlidersConfig) -> Terrain:
            return Terrain(resolution=self.resolution)

    existing = r"^task Fine: the terrain's 10 x 7 patches at 0.0005 m have .* use a resolution"
    with pytest.raises(ValueError, match=existing):
        Fine.sketch(SlidersConfig())
    Fine.resolution = 0.1
    assert isinstance(Fine.sketch(SlidersConfig()).ground_terrain, Terrain)


NUMBERS: Mapping[str, tuple[str, Any, str]] = {
    "mass": ("randomize.mass.range", [-3.0, -2.0], "randomize mass: the range (-3.0, -2.0) would make mass negative"),
    "no entry": ("randomize.mas.range", [1.0, 2.0], "the task has no number 'randomize.mas.range'; did you mean"),
    "seconds": ("commands.target.seconds", [-3.0, -2.0], "expected the least and the greatest time, above 0"),
    "interval": ("events.kick.seconds", [2.0, 1.0], "expected the least and the greatest time, above 0"),
    "clip": ("actions.force.clip", [1.0, -1.0], "expected the lesser number first"),
    "noise": ("observations.noisy.noise", -1.0, "expected 0 or more, found [-1.0]"),
}


@pytest.mark.parametrize(("place", "value", "message"), NUMBERS.values(), ids=list(NUMBERS))
def test_numbers_of_a_job_are_checked_as_those_of_the_declaration(place: str, value: Any, message: str) -> None:
    found = refused(SlidersConfig(numbers={place: value}))
    where = "config.numbers" if "no number" in message else f"config.numbers.{place}"
    assert found.startswith(f"{where}: {message}")


def test_a_curriculum_is_checked_when_the_task_is_built() -> None:
    def course(place: str, *values: float) -> str:
        return refused(SlidersConfig(curriculum={place: tuple(enumerate(values))}))

    assert course("rewards.plce.x", 1.0).startswith("config.curriculum: the task has no number 'rewards.plce.x'")
    assert course("randomize.mas.range", 1.0).startswith("config.curriculum: the task has no number 'randomize.mas.")
    assert course("events.kick.seconds", 1.0, -1.0).startswith("config.curriculum.events.kick.seconds: expected the")
    assert course("randomize.mass.range", 1.0, -1.0).startswith("config.curriculum.randomize.mass.range: randomize")
    adaptive = Adaptive("randomize.mass.range", 1.0, 0.0)
    assert refused(curricula={"heavy": adaptive}).startswith("curricula.heavy.randomize.mass.range: randomize mass")


@pytest.mark.parametrize(
    ("place", "meant"),
    [
        ("events.kik.speed", "did you mean events.kick.speed?"),
        ("sped", "did you mean events.kick.speed?"),
        ("randomise.mass.range", "did you mean randomize.mass.range?"),
        ("alive", "there are actions.force.clip, "),
    ],
)
def test_a_wrong_place_of_a_curriculum_names_the_nearest(place: str, meant: str) -> None:
    found = refused(curricula={"kicks": Adaptive(place, 0.0, 1.0)})
    assert found.startswith(f"curricula.kicks: the task has no number '{place}'; {meant}")


def test_the_points_of_a_scan_are_the_declarations_alone() -> None:
    scan = HeightScan(bodies=("near", "far"), pattern=RingPattern(radius=0.04, count=4, center=True))
    sections = {"sensors": {"scan": scan}, "observations": {"a": Observation(terms.frame_clearance, points=5)}}
    found = refused(SlidersConfig(numbers={"observations.a.points": 50.0}), **sections)
    assert found == "config.numbers.observations.a.points: the declaration alone can change it from 5"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Robot(MODEL, position=(0.0, 0.0)), "Robot robot: position is (0.0, 0.0); give 3 finite numbers"),
        (lambda: Robot(MODEL, rotation=(1.0,)), "Robot robot: rotation is (1.0,); give 4 finite numbers"),
        (lambda: Robot(MODEL, name="a/b"), "the name of a robot or object is a word without slashes, not 'a/b'"),
    ],
)
def test_robots_that_cannot_be_placed_or_called(make: Callable[[], Robot], message: str) -> None:
    assert refusal(make) == message


@pytest.mark.parametrize("name", ["bytes.xml", "bytes.urdf"])
def test_a_robots_file_that_is_not_text_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(bytes(range(256)))

    class Unreadable(Sliders):
        def robot(self, config: SlidersConfig) -> Robot:
            return Robot(tmp_path / name)

    with pytest.raises(
        ValueError, match=rf"{name}: the file is not text in UTF-8 \(invalid start byte at byte 128\); declare its enc"
    ):
        Unreadable.sketch(SlidersConfig())
