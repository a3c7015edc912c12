"""A mistake in a user's own task is told in one line: task, file and line, error, nearest name."""

from __future__ import annotations

import errno
import operator
import sys
from pathlib import Path

import pytest

from worker.tasks import find_task
from worker.tasks.__main__ import describe
from worker.tasks.mistakes import TaskMistake, task_mistakes

TASK = """import warp as wp
from worker.tasks import DeclaredTask, TaskConfig, WorldArrays, Declaration, Action, Observation, Reward, Robot, terms

@wp.func
def typo(world: int, worlds: WorldArrays) -> float:
    return worlds.joint_qq[world, 0]

class Bad(DeclaredTask):
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


def told(folder: Path, name: str, text: str) -> str:
    """What is said of a task whose module has this text."""
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
    said = told(folder, "mistaken", TASK.format(robot=robot, declare=declare))
    assert said.startswith(f"task mistaken:Bad: mistaken.py:{words}")
    assert "sqared" not in declare or said.endswith("did you mean joint_velocity_squared?")


def test_an_error_at_the_import_names_its_line(folder: Path) -> None:
    assert told(folder, "unclosed", "x = (\n") == "task unclosed:Bad: unclosed.py:1: SyntaxError: '(' was never closed"
    said = told(folder, "misnamed", "\nfrom worker.tasks import Rewrd\n")
    assert said.startswith("task misnamed:Bad: misnamed.py:2: ImportError: cannot import name 'Rewrd'")
    assert said.endswith("did you mean Reward?")


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


def test_transient_errors_and_musters_own_defects_are_not_mistakes_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    for error in (MemoryError(), OSError(errno.EIO, "a disk"), RuntimeError("CUDA error: out of memory")):
        with pytest.raises(type(error)) as passed, task_mistakes("mine:Bad"):
            raise error
        assert passed.value is error
    monkeypatch.setattr(find_task("Cartpole"), "sketch", operator.neg)  # raises in C, called by our own code alone
    with pytest.raises(TypeError, match="bad operand type"):
        describe("Cartpole")
