"""``train.config`` is refused at the submission, with file, line and key, in the words in which a rank refuses it."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.domain.errors import SpecError
from orchestrator.spec.file import load
from orchestrator.spec.json_schema import schema
from orchestrator.spec.model import validate
from orchestrator.spec.settings import task_config
from orchestrator.spec.values import known_tasks
from tests.support.refusals import refusal
from worker.learning.job import configure, user_errors
from worker.settings.errors import UserError
from worker.settings.overrides import configured
from worker.tasks import find_task
from worker.tasks.run.find import BUILT_IN

TWO_FACTORS = "expected [least, greatest], two factors"
WRONG = {
    # misspelt
    "Ant fall_hight: 0.3": "fall_hight: AntConfig has no such key; did you mean fall_height?",
    "Ant randomize: {mas: [1, 2]}": "randomize.mas: Randomization has no such key; did you mean mass?",
    "Ant rewards: {foward: 1.0}": "rewards.foward: the task has no term 'foward'; did you mean forward?",
    "Cartpole rewards: {xyz: 1.0}": "rewards.xyz: the task has no term 'xyz'; available: alive, angle, position",
    "CartpolePixels camera: {witdh: 32}": "camera.witdh: CameraConfig has no such key; did you mean width?",
    # another type
    "Ant fall_height: low": "fall_height: expected a number, found a string ('low')",
    "Ant fall_height: 3e-1": "fall_height: expected a number, found a string ('3e-1'); in YAML it is written 3.0e-1",
    "Ant fall_height: true": "fall_height: expected a number, found true or false (True)",
    "Ant fall_height: null": "fall_height: expected a number, found nothing",
    "Quadruped substeps: 1.5": "substeps: expected an integer, found a number (1.5)",
    "Ant rewards: [1.0]": "rewards: expected an object, found a list",
    "Ant rewards: {up: 1, fall: high}": "rewards.fall: expected a number, found a string ('high')",
    "Ant randomize: 3": "randomize: expected an object, found an integer (3)",
    # out of range
    "Ant control_hz: 0": "control_hz: expected a value greater than 0, found 0",
    "Cartpole substeps: 0": "substeps: expected a value greater than or equal to 1, found 0",
    "Humanoid nan_limit: -0.5": "nan_limit: expected a value greater than or equal to 0, found -0.5",
    "Quadruped command_turn: [1, -1]": "command_turn: expected [least, greatest], found [1, -1]",
    "Quadruped command_turn: [1.0]": "command_turn: expected [least, greatest], found [1.0]",
    "Quadruped command_seconds: 0": "command_seconds: expected a value greater than 0, found 0",
    "Quadruped command_stand: 2": "command_stand: expected a value less than or equal to 1, found 2",
    "Ant randomize: {mass: [0, 1]}": f"randomize.mass: {TWO_FACTORS} above 0, found [0, 1]",
    "Ant randomize: {gravity: [1]}": f"randomize.gravity: {TWO_FACTORS} of 0 or more, found [1]",
    "CartpolePixels camera: {samples: 65}": "camera.samples: expected a value less than or equal to 64, found 65",
    "CartpolePixels camera: {target: [0, 1]}": "camera.target: expected [x, y, z], found [0, 1]",
    # weights
    "Ant rewards: {7: 1.0}": "rewards.7: expected a string, found an integer (7)",
    "Ant rewards: {forward: true}": "rewards.forward: expected a number, found true or false (True)",
    "Ant rewards: {forward: .nan}": "rewards.forward: expected a finite number, found a number (nan)",
    "Ant rewards: {up: .inf}": "rewards.up: expected a finite number, found a number (inf)",
    "Ant rewards: {up: null}": "rewards.up: expected a number, found nothing",
    # a curriculum
    "Ant curriculum: {forwrd: [[0, 1]]}": "curriculum.forwrd: there is no such term; did you mean forward?",
    "Ant curriculum: {forward: 3}": "curriculum.forward: expected points [iteration, value], found 3",
    "Ant curriculum: {forward: []}": "curriculum.forward: expected points [iteration, value], found []",
    "Ant curriculum: {level: [[0, 2]]}": "curriculum.level: expected levels from 0 to 1, found [[0, 2]]",
    "Ant curriculum: {up: [[5, 1], [2, 1]]}": (
        "curriculum.up: the iterations of its points must grow, found [[5, 1], [2, 1]]"
    ),
    # several fields together
    "Ant randomize: {push_interval: 2}": "randomize: push_interval and push_velocity: give both, or none",
    "Ant randomize: {colors: 0.1}": "randomize.colors: AntConfig has no camera that would see it",
    "CartpolePixels randomize: {observation_noise: 0.1}": (
        "randomize.observation_noise: it is for numbers, not for images; use light and colors"
    ),
    "CartpolePixels camera: {target: [0, -3.2, 1.4]}": (
        "camera.target: the camera stands there, at [0.0, -3.2, 1.4]; choose another point"
    ),
    # how it is trained
    "Ant ppo: {steps: 8}": "ppo: not a key of AntConfig; settings of ppo stand under train.ppo",
    "Ant sac: {steps: 8}": "sac: not a key of AntConfig; settings of sac stand under train.sac",
}
"""Task and configuration: the message about it."""


@pytest.mark.parametrize("case", WRONG)
def test_the_submission_and_the_rank_refuse_the_same_in_the_same_words(tmp_path: Path, case: str) -> None:
    task, config = case.split(" ", 1)
    path = tmp_path / "job.yaml"
    path.write_text(f"name: a\ntrain:\n  task: {task}\n  worlds: 4\n  iterations: 2\n  config:\n    {config}\n")
    submitted = refusal(load, str(path), error=SpecError)
    assert submitted.startswith(f"{path}:7: train.config.{WRONG[case]}")
    train = yaml.safe_load(path.read_text())["train"]

    def start() -> None:
        with user_errors():
            find_task(task).sketch(configure(find_task(task), train))

    # only the whole task knows its terms, and names the place in its configuration
    started = refusal(start, error=UserError).removeprefix("train.")
    assert submitted == f"{path}:7: train.{started}"


def test_the_line_is_that_of_the_value_and_a_change_has_none(tmp_path: Path) -> None:
    path = tmp_path / "job.yaml"
    config = "  config:\n    rewards:\n      up: 1\n      fall: -1\n      foward: 2\n"
    path.write_text(f"name: a\ntrain:\n  task: Ant\n  worlds: 4\n  iterations: 2\n{config}")
    with pytest.raises(SpecError, match=r"job\.yaml:10: train\.config\.rewards\.foward: the task has no term"):
        load(str(path))
    path.write_text("name: a\ntrain: {task: Ant, worlds: 4, iterations: 2}\n")
    output = refusal(load, str(path), ["train.config.fall_height=low"], error=SpecError)
    assert output == "--set: train.config.fall_height: expected a number, found a string ('low')"


def test_every_installed_task_publishes_the_class_that_its_rank_uses() -> None:
    assert {entry.name for entry in entry_points(group="muster.task_settings")} == set(known_tasks())
    for task in known_tasks():
        assert task_config(task) is find_task(task).config_type


def test_no_simulation_is_imported_to_check() -> None:
    code = (
        "import sys; from orchestrator.spec.settings import task_config; from orchestrator.spec.values import known_tasks\n"
        "from orchestrator.spec.json_schema import schema; schema()\n"
        "assert all(task_config(task).problem_with({'substeps': 0}) for task in known_tasks())\n"
        "print(*sys.modules)"
    )
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "worker.settings.running" in loaded
    assert not {"torch", "warp", "newton", "numpy", "mujoco", "gymnasium"} & set(loaded)


KEYS = ["rewards", "randomize", "curriculum", "camera", "command_turn", "substeps", "ppo", "nan_limit"]
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-3, 2**63) | st.floats() | st.text(max_size=6),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["mass", "up", "level", "width", "target", "*"]) | st.integers(0, 3), inner)
    ),
    max_leaves=8,
)


@given(
    st.sampled_from(["Ant", "CartpolePixels", "Quadruped"]), st.dictionaries(st.sampled_from(KEYS), VALUES, max_size=3)
)
def test_any_configuration_is_taken_or_refused_in_one_line(task: str, config: dict[str, object]) -> None:
    problem = task_config(task).problem_with(config)
    if problem is None:
        assert isinstance(configured(find_task(task).config_type, config), find_task(task).config_type)
    else:
        path, words = problem
        assert (not path or path[0] in config) and "\n" not in words and len(words) < 500


def submit(task: str, config: dict[str, object]) -> None:
    validate({"name": "a", "train": {"task": task, "worlds": 1, "iterations": 1, "config": config}}, "job.yaml")


REACH = """
from collections.abc import Mapping
from dataclasses import dataclass
from worker.settings.task import TaskConfig, reward_weights

@dataclass(frozen=True)
class ReachConfig(TaskConfig):
    reach: float = 0.5
    rewards: Mapping[str, float] = reward_weights(near=1.0)

class Thing: ...

@dataclass(frozen=True)
class CarelessConfig(ReachConfig):
    thing: Thing = Thing()

    def __post_init__(self):
        super().__post_init__()
        if self.reach > 1.0:
            raise KeyError("reach")
"""


@pytest.fixture
def reach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package with three tasks: one is fine, one's configuration can't be imported, one's has a defect."""
    (tmp_path / "reach_config.py").write_text(REACH)
    (tmp_path / "reach_task.py").write_text("class Reach: ...\nclass Broken: ...\nclass Careless: ...\n")
    (tmp_path / "reach-1.0.dist-info").mkdir()
    (tmp_path / "reach-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: reach\nVersion: 1.0\n")
    (tmp_path / "reach-1.0.dist-info" / "entry_points.txt").write_text(
        "[muster.tasks]\nReach = reach_task:Reach\nBroken = reach_task:Broken\nCareless = reach_task:Careless\n"
        "[muster.task_settings]\nReach = reach_config:ReachConfig\nBroken = no_such_module:BrokenConfig\n"
        "Careless = reach_config:CarelessConfig\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("reach")
def test_a_task_of_an_installed_package_is_checked_by_the_class_that_it_names() -> None:
    submit("Reach", {"reach": 1, "rewards": {"near": 2}})
    for config, output in (
        ({"reach": "far"}, "reach: expected a number, found a string ('far')"),
        ({"rewards": {"nera": 1}}, "rewards.nera: the task has no term 'nera'; did you mean near?"),
        ({"substeps": 0}, "substeps: expected a value greater than or equal to 1, found 0"),
    ):
        assert refusal(submit, "Reach", config, error=SpecError) == f"job.yaml: train.config.{output}"


@pytest.mark.usefixtures("reach")
def test_settings_that_need_the_task_are_left_to_the_rank() -> None:
    submit("Broken", {"anything": 1})
    submit("Careless", {"reach": 2})
    submit("job_specs.my_task:Pendulum", {"anything": 1})
    submit("Ant", {})


@pytest.mark.usefixtures("reach")
def test_the_json_schema_has_the_installed_tasks_that_json_can_describe() -> None:
    described = {each["if"]["properties"]["task"]["const"] for each in schema()["$defs"]["Train"]["allOf"]}
    assert described >= {*BUILT_IN, "Reach"}
