"""What a declaration or a job gives a task and can't be: one line each, before any world is built."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from job_specs.my_kernels import PendulumByHand, PendulumConfig
from tests.support.refusals import refusal
from tests.support.worker.declared import MODEL, Sliders, SlidersConfig, kick, target
from worker.simulation.sensors.height_scan import HeightScan, RingPattern
from worker.simulation.terrain import Terrain
from worker.tasks import Action, Adaptive, Command, Event, Observation, Robot, terms
from worker.tasks.randomize import Randomize


def refused(config: SlidersConfig | None = None, **changed: Any) -> str:
    """The line with which sliders of other sections are refused."""

    class Wrong(Sliders):
        def sections(self) -> dict[str, Any]:
            return {**super().sections(), **changed}

    return refusal(Wrong.sketch, config or SlidersConfig()).removeprefix("task Wrong: ")


OBSERVATIONS: Mapping[str, tuple[dict[str, Any], str]] = {
    "noise of one": (dict(noise=("normal",)), "noise is ('normal',); give half the width, 0 or more, or (\"normal\", "),
    "noise by pattern": (
        dict(noise={"*": 0.1}),
        "noise is {'*': 0.1}; give half the width, 0 or more, or (\"normal\", ",
    ),
    "unknown noise": (dict(noise=("gauss", 0.1)), "noise is ('gauss', 0.1); give half the width"),
    "negative noise": (dict(noise=-0.1), "noise is -0.1; give half the width, 0 or more"),
    "half a step": (dict(delay=1.5), "delay is 1.5; give whole control steps, from 0 up, or two, the lesser first"),
    "one of two delays": (dict(delay=(1,)), "delay is (1,); give whole control steps"),
    "delays the wrong way": (dict(delay=(2, 1)), "delay is (2, 1); give whole control steps"),
    "history": (dict(history=2.0), "history is 2.0; it counts the present step, so it is 1 or more"),
    "units": (dict(unit=("m",)), "1 units for 2 columns; give one for all, or one for each"),
    "memory": (dict(memory=-2), "memory is -2; give a whole number from 0 up"),
}


@pytest.mark.parametrize(("options", "message"), OBSERVATIONS.values(), ids=list(OBSERVATIONS))
def test_options_of_an_observation(options: dict[str, Any], message: str) -> None:
    found = refused(observations={"a": Observation(terms.joint_position, **options)})
    assert found.startswith(f"observations.a: {message}")


def test_ends_the_wrong_way_round() -> None:
    wrong = ".clip: expected the lesser number first, found [1.0, -1.0]"
    observed = Observation(terms.joint_position, clip=(1.0, -1.0))
    assert refused(observations={"a": observed}) == f"observations.a{wrong}"
    assert refused(actions={"force": Action(terms.effort, clip=(1.0, -1.0))}) == f"actions.force{wrong}"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(seconds="a"), "commands.target.seconds: expected 2 numbers, found 'a'"),
        (dict(seconds=(0.0, 1.0)), "commands.target.seconds: expected the least and the greatest time, above 0"),
        (dict(units=("m", "s")), "commands.target: 2 units for 1 numbers; give one for each"),
        (dict(names=()), "commands.target: names are (); name each number that the policy is told"),
        (dict(names=3), "commands.target: names are (3,); name each number that the policy is told"),
        (dict(hidden=-1), "commands.target: hidden is -1; give how many numbers, from 0 up"),
    ],
)
def test_options_of_a_command(options: dict[str, Any], message: str) -> None:
    command = Command(target, **{"names": ("place",), "place": (-1.0, 1.0), **options})
    assert refused(commands={"target": command}).startswith(message)


@pytest.mark.parametrize("seconds", [2.0, (2.0,)])
def test_an_interval_has_two_times(seconds: Any) -> None:
    event = Event(kick, speed=1.0, when="interval", seconds=seconds)
    assert refused(events={"e": event}, curricula={}).startswith("events.e.seconds: expected 2 numbers, found ")


def test_sections_hold_what_they_are_for() -> None:
    assert refused(randomize={"m": "mass"}) == "randomize.m: expected a Randomize, found a str"
    assert refused(sensors={"m": "mass"}) == "sensors.m: expected a sensor, such as ContactSensor(...), found a str"


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (
            Randomize("mass", bodies="nar", range=(0.5, 1.0)),
            "no body of robot matches 'nar'; did you mean near? there are near, far",
        ),
        (Randomize("encoder_bias", joints="third*", range=(0.0, 0.1)), "no joint of robot matches 'third*'; "),
        (Randomize("stiffness", actuators="frst", range=(0.5, 1.0)), "no joint of robot matches 'frst'; did you mean"),
        (Randomize("friction", geoms=("*", "foot"), range=(0.5, 1.0)), "no geom of robot matches 'foot'; "),
        (Randomize("mass", bodies="*", robot="robt", range=(0.5, 1.0)), "no robot or object is called 'robt'; did you"),
    ],
)
def test_what_is_randomized_must_be_there(entry: Randomize, message: str) -> None:
    assert refused(randomize={"f": entry}).startswith(f"randomize.f: {message}")


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

    there = r"^task Fine: the terrain's 10 x 7 patches at 0.0005 m have .* use a resolution"
    with pytest.raises(ValueError, match=there):
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
def test_robots_that_can_not_be_placed_or_called(make: Callable[[], Robot], message: str) -> None:
    assert refusal(make) == message


@pytest.mark.parametrize("name", ["bytes.xml", "bytes.urdf"])
def test_a_robots_file_that_is_not_text_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(bytes(range(256)))

    class Unreadable(Sliders):
        def robot(self, config: SlidersConfig) -> Robot:
            return Robot(tmp_path / name)

    with pytest.raises(ValueError, match=rf"{name}: the file is not text in UTF-8 \(invalid start byte at byte 128\)$"):
        Unreadable.sketch(SlidersConfig())


def test_a_task_of_kernels_has_no_numbers_for_a_curriculum() -> None:
    config = PendulumConfig(curriculum={"events.push.speed": ((0, 1.0),)})
    with pytest.raises(
        ValueError, match=r"^task PendulumByHand: curriculum: it has no number events.push.speed; declared"
    ):
        PendulumByHand(config, 1)
