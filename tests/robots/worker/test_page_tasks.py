"""The tasks that the pages show: they run as they are printed there, and say what the pages say."""

from __future__ import annotations

import ast
import math
import re
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import pytest
import torch
import warp as wp
import yaml

from docs.tools.settings_page import sketch
from tests.conftest import REPOSITORY
from tests.support.worker.page_tasks import blocks, module
from tests.support.worker.robots import need_mjlab
from tests.support.worker.tasks import observe, put
from worker.learning.job import configure
from worker.settings.velocity import Go1FlatConfig
from worker.tasks import find_task
from worker.tasks.run.task import Task

SIZES = re.compile(r"(\d+) observations, (\d+) actions?")


def played(task: Task, steps: int = 3) -> Task:
    """A task after some random steps, whose sizes are those of its docstring."""
    generator = torch.Generator().manual_seed(1)
    for _ in range(steps):
        task.step(torch.randn(task.world_count, task.action_size, generator=generator))
    assert task.observations.isfinite().all()
    reported = SIZES.search(type(task).__doc__ or "")
    assert not reported or (len(task.observation_names), task.action_size) == (int(reported[1]), int(reported[2]))
    return task


def test_the_tutorial_shows_the_example_as_it_is() -> None:
    example = (REPOSITORY / "job_specs/my_task.py").read_text().split('"""', 2)[2].strip()
    assert example in (block.strip() for block in blocks("own-task.md"))


def test_a_reward_is_added_to_g1_in_eight_lines_and_drafted_in_torch(tmp_path: Path) -> None:
    need_mjlab()
    assert len([line for line in blocks("own-task.md")[0].splitlines() if line.strip()]) == 8
    page = module("own-task.md", tmp_path)
    tasks = [played(kind(kind.config_type(), 2, seed=1)) for kind in (page.Mine, page.Draft)]
    sums = [task.state_dict()["episode_sums"][:, 2 + task.reward_terms.index("feet_flat")] for task in tasks]
    assert (sums[0] < 0.0).all() and torch.allclose(*sums, rtol=1e-4)
    calm = page.Calm.sketch(page.Calm.config_type())
    assert "air_time" not in calm.reward_terms and calm.config.episode_seconds == 10.0
    assert calm.config.ppo.learning_rate == 5e-4 and "push_robot" not in calm.declaration.events


def test_mjlabs_side_of_the_tutorial_names_what_mjlab_has() -> None:
    """Its own packages are not installed here, so that it can't run: names and keywords are judged by its source."""
    need_mjlab()
    root = Path(str(metadata.distribution("mjlab").locate_file("")))

    def names(module: str) -> dict[str, ast.stmt]:
        path = root / module.replace(".", "/")
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        found: dict[str, ast.stmt] = {}
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found[node.name] = node
            elif isinstance(node, ast.ImportFrom):
                found |= {each.asname or each.name: node for each in node.names}
                if any(each.name == "*" for each in node.names):
                    found |= names(f"{module}.{node.module}" if node.level else f"{node.module}")
        return found

    imported, used = 0, set[str]()
    for node in ast.walk(ast.parse("".join(blocks("own-task.md", "python mjlab")))):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("mjlab"):
            known = names(str(node.module)) | dict.fromkeys(("mdp",), node)
            assert [each.name for each in node.names if each.name not in known] == [], node.module
            imported += len(node.names)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "mdp":
            used.add(node.attr)
    assert imported > 15 and used - names("mjlab.envs.mdp").keys() == set()


def test_the_tutorials_further_tasks_run(tmp_path: Path) -> None:
    page = module("own-task.md", tmp_path)
    task = played(page.Everything(page.Everything.config_type(), 3, seed=1), 40)
    assert task.groups["policy"].shape == (3, 6) and task.groups["critic"].shape == (3, 8)
    assert {"metric_power", "termination_spins", "termination_bored"} <= set(task.statistic_names)
    angle, velocity = task.worlds.state.joint_q.numpy(), task.worlds.state.joint_qd.numpy()
    energy = 0.5 * (-9.81 * 0.25) * math.cos(angle[1]) + 0.5 * 0.25 / 6.0 * velocity[1] ** 2
    assert task.groups["critic"][1, 7].item() == pytest.approx(0.2 * energy, rel=1e-4)
    assert "wanted: 1 x (rad - 0)" in page.contract(task)
    assert page.Chooser.sketch(page.Chooser.config_type()).action_names == ("left", "none", "right")
    assert page.Judged.sketch(page.Judged.config_type()).success == "still"
    torqued = page.Torqued.sketch(page.TorquedConfig(torque=0.5))
    assert torqued.plan.numbers.values[torqued.plan.numbers.places["actions.torque.scale"][0]] == 0.5
    with pytest.raises(ValueError, match="torque"):
        page.TorquedConfig(torque=2.0)


def test_a_cube_beside_the_pendulum_falls_onto_the_ground(tmp_path: Path) -> None:
    page = module("own-task.md", tmp_path)
    task = played(page.WithCube(page.WithCube.config_type(), 2, seed=1), 30)
    assert task.observation_names[-1] == "cube"
    assert task.observations[:, 3].tolist() == pytest.approx([0.05, 0.05], abs=3e-3)


def test_the_tutorials_jobs_fit_the_example() -> None:
    page = (REPOSITORY / "docs/own-task.md").read_text()
    jobs = [yaml.safe_load(block) for block in re.findall(r"^```yaml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)]
    jobs.insert(0, yaml.safe_load((REPOSITORY / "job_specs/my-task.yaml").read_text()))
    assert len(jobs) == 2
    for job in jobs:
        task_type = find_task(job["train"]["task"])
        config = configure(task_type, job["train"])
        sketch = task_type.sketch(config)
        for place in [name for name in config.curriculum if "." in name]:
            sketch.plan.numbers.find(place, "curriculum")
    assert sketch.plan.numbers.values[sketch.plan.numbers.places["rewards.upright.target"][0]] == 3.0


def test_the_page_s_error_for_a_wrong_parameter_is_the_real_one(tmp_path: Path) -> None:
    page = module("own-task.md", tmp_path)

    wrong = page.Pendulum.with_(rewards={"upright": page.Reward(page.pointing, weight=1.0, targt=1.0)})
    line = next(line for line in (REPOSITORY / "docs/own-task.md").read_text().splitlines() if "targt" in line)
    with pytest.raises(ValueError, match="targt") as caught:
        wrong.sketch(wrong.config_type())
    assert str(caught.value) == line


def test_isaac_labs_cartpole_as_it_is_on_the_page(tmp_path: Path) -> None:
    page = module("tasks/ports.md", tmp_path)
    task = played(page.IsaacCartpole(page.IsaacCartpoleConfig(), 4, seed=1))
    assert task.max_episode_length == 300
    put(task, joint_q=[[0.5, 0.3], [-3.5, -0.4 - 2.0 * math.pi]], joint_qd=[[-2.0, 4.0], [1.0, 0.0]])
    observe(task)
    # Isaac Lab's rewards by hand: weight x value x the control step
    by_hand = [(1.0 - 0.3**2 - 0.01 * 2.0 - 0.005 * 4.0) / 60.0, (-2.0 - 0.4**2 - 0.01) / 60.0]
    assert task.rewards[:2].tolist() == pytest.approx(by_hand, abs=1e-6)
    assert task.dones[:2].tolist() == [False, True] and not task.time_outs[1]
    assert task.observations[0].tolist() == pytest.approx([0.5, 0.3, -2.0, 4.0], abs=1e-6)
    [action] = task.interface().actions
    assert (action.name, action.scale, action.clip, action.effort_limit) == ("slider_to_cart", 100.0, None, 400.0)


def test_mjlabs_go1_on_the_page_has_the_functions_and_weights_of_the_task() -> None:
    need_mjlab()
    declared, weights = sketch("Go1Flat").task.plan.declaration, Go1FlatConfig().rewards
    table = (REPOSITORY / "docs/tasks/ports.md").read_text().partition("## mjlab")[2]
    rows = {line.split("`")[1].partition(":")[0]: line for line in table.splitlines() if line.startswith("| `")}
    shown = {name: reward for name, reward in declared.rewards.items() if weights[name]}
    wrong = [
        name
        for name, reward in shown.items()
        if f"terms.{reward.function.key}" not in rows[name]
        or f"{weights[name]}" not in rows[name].replace("-1e-5", "-1e-05")
    ]
    assert len(shown) == 10 and wrong == []
    assert "`body_ang_vel`, `angular_momentum`, `air_time`: weight 0" in table
    assert {name for name in weights if not weights[name]} == {"body_ang_vel", "angular_momentum", "air_time"}


def test_the_ant_of_the_page_on_sensors_feels(tmp_path: Path) -> None:
    page = module("tasks/sensors.md", tmp_path)
    task = played(page.FeelingAnt(page.FeelingAntConfig(), 2, seed=1), 60)
    touches = [task.observation_names.index(name) for name in task.observation_names if name.endswith("_touches")]
    assert len(touches) == 4 and task.observations[:, touches].sum() > 0


def test_the_hand_of_the_page_on_sensors_goes_up(tmp_path: Path) -> None:
    page = module("tasks/sensors.md", tmp_path)
    task = page.LiftCubeByHand(page.LiftCubeByHand.config_type(), 2, seed=1)
    assert task.action_names[:3] == ("grasp_site_x", "grasp_site_y", "grasp_site_z") and task.action_size == 7
    task.reset()
    places = wp.to_torch(task.sensors["hand"].arrays.positions)[:, 0]
    begin = places.clone()
    for _ in range(30):
        task.step(torch.tensor([[0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]] * 2))
    moved = places - begin
    assert (moved[:, 2] > 0.03).all() and (moved[:, 1].abs() < 0.005).all()


def test_the_climber_and_the_ridges_of_the_page_on_terrain(tmp_path: Path) -> None:
    page = module("tasks/terrain.md", tmp_path)
    task = played(page.Climber(page.ClimberConfig(), 6, seed=1), 5)
    heights = [task.observation_names.index(f"heights_{point}") for point in range(49)]
    assert ((task.observations[:, heights] + 0.5 - 0.62).abs() < 0.4).all()
    assert page.ridges.heights.max() == pytest.approx(0.3, abs=0.02)


def test_the_entries_of_the_page_on_randomisation_fit_an_ant(tmp_path: Path) -> None:
    page = module("tasks/sensors.md", tmp_path)
    entries = module("tasks/randomization.md", tmp_path).randomize

    class Varied(page.FeelingAnt):
        def declare(self, config):
            return replace(super().declare(config), randomize=entries)

    task = Varied(page.FeelingAntConfig(), 4, seed=1)
    view, model = task.views["robot"], task.worlds.solver.mjw_model
    masses = model.body_mass.numpy()[:, 1]
    own = task.worlds.solver.mj_model.body_mass[1]
    assert len(set(masses)) == 4 and (masses > 0.8 * own).all() and (masses < 1.2 * own + 0.5).all()
    assert view.find_bodies("torso") == [0]
    gravity = model.opt.gravity.numpy()[:, 2]
    assert len(set(gravity)) == 4 and (abs(gravity + 9.81) <= 0.2001).all()
    assert task.numbers("randomize.torso.range").flatten().tolist() == pytest.approx([0.8, 1.2])
