"""What a job's overrides make of a task's configuration; a mistake in a user's own task is reported in one line."""

from __future__ import annotations

import dataclasses
import errno
import math
import operator
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from job_specs.my_task import Pendulum
from tests.support.refusals import refusal
from worker.learning.job import configure
from worker.settings.camera import CameraConfig
from worker.settings.errors import UserError
from worker.settings.overrides import Refused, configured
from worker.settings.ppo import PPOConfig
from worker.settings.task import Randomization, TaskConfig, reward_weights
from worker.tasks import find_task
from worker.tasks.__main__ import describe
from worker.tasks.library.ant import Ant, AntConfig
from worker.tasks.library.cartpole_pixels import CartpolePixels, CartpolePixelsConfig
from worker.tasks.run.mistakes import TaskMistake, task_mistakes


@dataclasses.dataclass(frozen=True)
class PendulumConfig(TaskConfig):
    episode_seconds: float = 4.0
    torque: float = 1.0
    rewards: Mapping[str, float] = reward_weights(upright=1.0, speed=-0.01, effort=-0.01)


class Torqued(Pendulum):
    config_type = PendulumConfig


def bits(value: Any) -> Any:
    """A configuration with the type of each number, which ``==`` does not compare."""
    if dataclasses.is_dataclass(value):
        return {item.name: bits(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {name: bits(each) for name, each in value.items()}
    return [bits(each) for each in value] if isinstance(value, list | tuple) else repr(value)


def test_whole_numbers_and_lists_of_a_yaml_give_the_same_bits_as_floats_and_tuples() -> None:
    written = configured(CartpolePixelsConfig, {"episode_seconds": 4, "camera": {"position": [0, -2, 1]}})
    camera = dataclasses.replace(CartpolePixelsConfig().camera, position=(0.0, -2.0, 1.0))
    assert bits(written) == bits(CartpolePixelsConfig(episode_seconds=4.0, camera=camera))
    changes = {"randomize": {"mass": [1, 2], "observation_noise": {"a": 1}}, "rewards": {"up": 2}}
    written = configured(AntConfig, changes)
    randomize = Randomization(mass=(1.0, 2.0), observation_noise={"a": 1.0})
    assert bits(written) == bits(AntConfig(randomize=randomize, rewards={"up": 2.0}))
    assert configured(AntConfig, {}) == AntConfig()


def test_a_mapping_changes_the_keys_that_it_names() -> None:
    config = configure(CartpolePixels, {"config": {"camera": {"width": 96}}})
    assert config.camera == dataclasses.replace(CartpolePixelsConfig().camera, width=96)
    assert config.camera.position == (0.0, -3.2, 1.4), "the task's own, not the camera's default"


def test_a_plain_dataclass_is_checked_by_the_types_of_its_fields() -> None:
    config = configure(Torqued, {"config": {"torque": 2, "randomize": {"mass": [1, 2]}, "rewards": {"effort": -1}}})
    assert type(config) is PendulumConfig and isinstance(config.torque, float)
    assert config == PendulumConfig(torque=2.0, randomize=Randomization(mass=(1.0, 2.0)), rewards={"effort": -1.0})
    for overrides, output in (
        ({"torqe": 1}, "torqe: PendulumConfig has no such key; did you mean torque?"),
        ({"torque": "much"}, "torque: expected a number, found a string ('much')"),
        ({"episode_seconds": -1}, "episode_seconds: expected a value greater than 0, found -1.0"),
        ({"rewards": {"speed": float("nan")}}, "rewards.speed: expected a finite number, found a number (nan)"),
    ):
        assert refusal(configure, Torqued, {"config": overrides}, error=UserError) == f"train.config.{output}"


def test_a_plain_dataclass_that_python_makes_is_checked_in_what_every_task_has() -> None:
    assert PendulumConfig(randomize={"mass": [1, 2]}).randomize == Randomization(mass=(1.0, 2.0))
    curriculum = {"level": [[0, 2]]}
    for wrong in ({"substeps": 0}, {"rewards": {"speed": "1"}}, {"control_hz": "60"}, {"curriculum": curriculum}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            PendulumConfig(**wrong)


@dataclasses.dataclass(frozen=True)
class Plain(TaskConfig):
    sizes: tuple[int, ...] = (8, 8)
    corners: tuple[tuple[float, float], ...] = ((0.0, 0.0), (1.0, 1.0))
    limit: float | None = None
    camera: CameraConfig = dataclasses.field(default_factory=lambda: CameraConfig(fov=0.5))
    rewards: Mapping[str, float] = reward_weights(near=1.0)
    ppo: PPOConfig = dataclasses.field(default_factory=lambda: PPOConfig(steps=7))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.limit == 0.0:
            raise ValueError("limit: 0 leaves no room")


def test_parts_of_a_plain_dataclass_are_checked_as_those_of_shipped_configurations() -> None:
    made = configured(
        Plain, {"sizes": [4], "corners": [[1, 2]], "limit": 3, "camera": {"width": 8}, "rewards": {"near": 2}}
    )
    assert type(made) is Plain and (made.sizes, made.corners, made.limit) == ((4,), ((1.0, 2.0),), 3.0)
    assert (made.camera.width, made.camera.fov, made.rewards, made.ppo.steps) == (8, 0.5, {"near": 2.0}, 7)
    for overrides, output in (
        ({"sizes": [4, "x"]}, "sizes.1: expected an integer, found a string ('x')"),
        ({"limit": "low"}, "limit: expected a number, found a string ('low')"),
        ({"limit": 0}, "limit: 0 leaves no room"),
        ({"camera": {"fov": 4}}, "camera.fov: expected a value less than 3.141592653589793, found 4"),
        ({"ppo": {"steps": 8}}, "ppo: not a key of Plain; settings of ppo stand under train.ppo"),
    ):
        assert refusal(configured, Plain, overrides, error=Refused) == output


def test_a_task_with_invalid_defaults_says_so() -> None:
    @dataclasses.dataclass(frozen=True)
    class Careless(PendulumConfig):
        substeps: int = 0

    class Task(Pendulum):
        config_type = Careless

    assert refusal(configure, Task, {}, error=UserError) == (
        "task Task: its own configuration: substeps: expected a value greater than or equal to 1, found 0"
    )


def test_a_yaml_changes_the_weights_that_it_names_and_nothing_does_afterwards() -> None:
    config = configure(Ant, {"config": {"rewards": {"forward": 2, "fall": -7.5}, "curriculum": {"up": [[0, 1]]}}})
    assert config.rewards == {**AntConfig().rewards, "forward": 2.0, "fall": -7.5}
    assert tuple(config.rewards) == tuple(AntConfig().rewards), "the order is the settings', whatever the YAML's"
    assert configure(Ant, {}).rewards == AntConfig().rewards and config.curriculum == {"up": [[0, 1]]}
    for mapping in (config.rewards, config.curriculum, AntConfig().curriculum):
        with pytest.raises(TypeError):
            mapping["up"] = 3.0


TASK = """import warp as wp
from worker.tasks import Task, TaskConfig, WorldArrays, Declaration, Action, Observation, Reward, Robot, terms

@wp.func
def typo(world: int, worlds: WorldArrays) -> float:
    return worlds.joint_qq[world, 0]

class Bad(Task):
    config_type = TaskConfig
    def robot(self, config):
        {robot}
    def declare(self, config):
        {declare}
"""
ROBOT = 'return Robot(\'<mujoco><worldbody><body><joint name="hinge"/><geom size=".1"/></body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>\')'


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def reported(folder: Path, name: str, text: str) -> str:
    """The message for a task whose module has this text."""
    (folder / f"{name}.py").write_text(text)
    with pytest.raises(TaskMistake) as mistake, task_mistakes(f"{name}:Bad"):
        kind = find_task(f"{name}:Bad")
        kind.sketch(kind.config_type())
    sys.modules.pop(name, None)
    assert "\n" not in str(mistake.value)
    return str(mistake.value)


@pytest.mark.parametrize(
    ("robot", "declare", "words"),
    [
        (ROBOT, "terms.joint_velocity_sqared", "13: AttributeError: "),
        (ROBOT, "return confg", "13: NameError: name 'confg' is not defined; did you mean config?"),
        (ROBOT, "return {}['key']", "13: KeyError: 'key'"),
        (ROBOT, "raise ValueError('no such leg')", "13: no such leg"),
        ("open('nothing.urdf')", "pass", "11: FileNotFoundError: [Errno 2] No such file or directory: 'nothing.urdf'"),
    ],
    ids=["term", "name", "key", "value", "file"],
)
def test_an_error_in_a_method_of_a_task_names_its_line(folder: Path, robot: str, declare: str, words: str) -> None:
    output = reported(folder, "mistaken", TASK.format(robot=robot, declare=declare))
    assert output.startswith(f"task mistaken:Bad: mistaken.py:{words}")
    assert "sqared" not in declare or output.endswith("did you mean joint_velocity_squared?")


def test_an_error_at_the_import_names_its_line(folder: Path) -> None:
    assert (
        reported(folder, "unclosed", "x = (\n") == "task unclosed:Bad: unclosed.py:1: SyntaxError: '(' was never closed"
    )
    output = reported(folder, "misnamed", "\nfrom worker.tasks import Rewrd\n")
    assert output.startswith("task misnamed:Bad: misnamed.py:2: ImportError: cannot import name 'Rewrd'")
    assert output.endswith("did you mean Reward?")


def test_a_function_that_warp_cannot_compile_is_named_first(folder: Path) -> None:
    declare = (
        "return Declaration(actions={'a': Action(terms.effort)}, "
        "observations={'p': Observation(terms.joint_position)}, rewards={'typo': Reward(typo)})"
    )
    text = TASK.replace("TaskConfig\n    def", "Config\n    def").format(robot=ROBOT, declare=declare)
    config = (
        "from dataclasses import dataclass\nfrom worker.tasks import reward_weights\n@dataclass(frozen=True)\n"
        "class Config(TaskConfig):\n    rewards: dict = reward_weights(typo=1.0)\n"
    )
    text = text.replace("class Bad", f"{config}class Bad")
    (folder / "warped.py").write_text(text)
    kind = find_task("warped:Bad")
    with pytest.raises(TaskMistake) as mistake, task_mistakes("warped:Bad"):
        kind(kind.config_type(), 2, seed=0, device="cpu")
    sys.modules.pop("warped", None)
    assert str(mistake.value).startswith("task warped:Bad: warped.py:6: `joint_qq` is not an attribute of 'worlds'")
    outer = "Invalid external reference type: <class 'warp._src.codegen.Struct.__init__.<locals>.NewStructInstance'>"
    words = "6: a Warp function can't use a Warp struct from outside; make it a parameter"
    with pytest.raises(TaskMistake, match=words), task_mistakes("warped:Bad"):
        raise TypeError(f'Error while parsing function "f" at {folder}/warped.py:6:\n    return M.a\n;{outer}')


def test_an_unknown_class_is_refused_with_the_tasks_of_its_module(folder: Path) -> None:
    (folder / "own.py").write_text(
        "from worker.tasks.library.cartpole import Cartpole\nMine = Cartpole.with_(config={'substeps': 2})\n"
        "Draft = Mine.with_(config={'substeps': 3})\n"
    )
    with pytest.raises(
        ValueError, match=r"own has no class 'Nope' that is a worker\.tasks\.Task; available: Mine, Draft$"
    ):
        find_task("own:Nope")
    sys.modules.pop("own", None)


def test_transient_errors_and_musters_own_defects_are_not_mistakes_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    for error in (MemoryError(), OSError(errno.EIO, "a disk"), RuntimeError("CUDA error: out of memory")):
        with pytest.raises(type(error)) as passed, task_mistakes("mine:Bad"):
            raise error
        assert passed.value is error
    monkeypatch.setattr(find_task("Cartpole"), "sketch", operator.neg)  # raises in C, called by our own code alone
    with pytest.raises(TypeError, match="bad operand type"):
        describe("Cartpole")


@pytest.mark.parametrize(
    "words",
    VALUES := {
        "substeps: expected a value less than or equal to 1000, found 100000": {"substeps": 100000},
        "control_hz: expected a finite number, found a number (nan)": {"control_hz": math.nan},
        "randomize.mass: expected [least, greatest], two factors above 0, found [2.0, 1.0]": {
            "randomize": {"mass": (2.0, 1.0)}
        },
    },
)
def test_a_value_in_python_is_refused_in_one_line_as_in_yaml(words: str) -> None:
    assert refusal(TaskConfig, **VALUES[words]) == words
