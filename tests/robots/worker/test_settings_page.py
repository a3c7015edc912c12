"""The page of the robots' settings is what the declarations give, and says of mjlab what is in its files."""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

from docs.tools.settings_page import FAMILIES, MJLAB, page, sketch
from tests.conftest import REPOSITORY
from tests.support.worker.robots import needs_mjlab
from worker.tasks.run.find import BUILT_IN

pytestmark = needs_mjlab
LIMITS = ("iterations", "ls_iterations", "nconmax", "njmax")


def test_the_page_is_up_to_date() -> None:
    assert (REPOSITORY / "docs" / "tasks" / "settings.md").read_text() == page()


def test_the_page_has_every_task_whose_robot_is_in_mjlab_and_every_term_of_it() -> None:
    names = [name for family in FAMILIES.values() for name in family]
    assert {*names} == {*MJLAB} == {name for name in BUILT_IN if name.startswith(("G1", "Go1", "Lift"))}
    text = page()
    for name in names:
        declared = sketch(name).task.plan.declaration
        terms = [*declared.rewards, *declared.terminations, *declared.events, *declared.randomize, *declared.commands]
        for group in declared.groups.values():
            terms += list(group)
        assert [term for term in terms if f"| `{term}` |" not in text] == []


def supplied(path: Path, function: str | None = None) -> dict[str, int | None]:
    """Limits of the solver as a file of mjlab's gives them: of its calls, or what a function sets afterwards."""
    tree: ast.AST = ast.parse(path.read_text())
    if function is not None:
        tree = next(each for each in ast.walk(tree) if isinstance(each, ast.FunctionDef) and each.name == function)
    found: dict[str, int | None] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("SimulationCfg", "MujocoCfg"):
            found |= {each.arg: ast.literal_eval(each.value) for each in node.keywords if each.arg in LIMITS}
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).startswith("cfg.sim."):
            name = ast.unparse(node.targets[0]).rpartition(".")[2]
            if name in LIMITS and isinstance(node.value, ast.Constant):
                found[name] = node.value.value
    return found


def test_what_it_says_of_mjlab_s_solver_is_in_mjlab_s_files() -> None:
    spec = find_spec("mjlab")
    assert spec is not None and spec.origin is not None
    tasks = Path(spec.origin).parent / "tasks"
    walking = supplied(tasks / "velocity" / "velocity_env_cfg.py")
    for robot in ("go1", "g1"):
        file = tasks / "velocity" / "config" / robot / "env_cfgs.py"
        rough: Mapping[str, int | None] = walking | supplied(file, f"unitree_{robot}_rough_env_cfg")
        title = robot.capitalize()
        assert MJLAB[f"{title}Rough"] == rough
        assert MJLAB[f"{title}Flat"] == rough | supplied(file, f"unitree_{robot}_flat_env_cfg")
    assert MJLAB["LiftCube"] == supplied(tasks / "manipulation" / "lift_cube_env_cfg.py")
    arm = (tasks / "manipulation" / "config" / "yam" / "env_cfgs.py").read_text()
    assert "cfg.sim.nconmax = max(cfg.sim.nconmax or 55, 55 + num_cubes * 120)" in arm and "num_cubes: int = 3" in arm
    assert MJLAB["LiftCubes"] == MJLAB["LiftCube"] | {"nconmax": 55 + 3 * 120}


@pytest.mark.parametrize(
    "name", ["go1-flat", "go1-rough", "g1-flat", "g1-rough", "g1-walk", "g1-rough-walk", "lift-cube", "lift-cubes"]
)
def test_a_job_s_file_says_how_many_steps_it_takes_and_how_to_try_it_without_a_gpu(name: str) -> None:
    text = (REPOSITORY / "job_specs" / f"{name}.yaml").read_text()
    train = yaml.safe_load(text)["train"]
    rollout = train.get("ppo", {}).get("steps", sketch(train["task"]).config.ppo.steps)
    steps = train["worlds"] * train["iterations"] * rollout
    output = re.search(r"It takes (\d+) million steps[.;]", text)
    assert output is not None and int(output[1]) == round(steps / 1e6)
    assert f"muster run job_specs/{name}.yaml --set resources.gpus=0" in text
