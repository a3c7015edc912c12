"""Worlds that are tiled are those that Newton and MuJoCo-Warp build one by one, bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import newton
import numpy as np
import pytest
import torch
import warp as wp
from newton.solvers import SolverMuJoCo

from tests.support.worker.robot_texts import template
from tests.support.worker.robots import needs_mjlab
from worker.simulation import tiling, worlds
from worker.simulation.actuators import EffortActuator, ExplicitPDActuator
from worker.simulation.robot import Robot
from worker.simulation.robot_elements import empty_builder
from worker.simulation.solver import Solver
from worker.tasks import find_task
from worker.tasks.run.find import BUILT_IN

COUNT = 7
TASKS = [*BUILT_IN, *(f"racer.car.task:{name}" for name in ("Racer", "RacerPixels"))]
MIXED = """<mujoco><worldbody><geom name="table" type="box" size=".3 .3 .1" pos="1 0 .1"/>
<body name="base" pos="0 0 .1"><freejoint/><geom name="foot" size=".11" mass="2"/>
  <body name="arm" pos="0 0 .3"><joint name="a" axis="0 1 0"/><joint name="b" axis="1 0 0" pos="0 0 .1"/>
    <geom type="capsule" size=".04 .1" mass="1"/><site name="tip" pos="0 0 .2"/></body>
  <body name="left" pos="0 .3 0"><joint name="c" type="slide" axis="0 1 0"/><geom size=".05" mass=".3"/></body>
  <body name="right" pos="0 -.3 0"><joint name="d" type="slide" axis="0 1 0"/><geom size=".05" mass=".3"/></body></body>
</worldbody><contact><exclude body1="left" body2="right"/></contact>
<tendon><fixed name="both"><joint joint="c" coef="1"/><joint joint="d" coef="-1"/></fixed></tendon>
<equality><joint joint1="c" joint2="d"/></equality></mujoco>"""
"""A robot with carriers, a tendon, an equality, an excluded pair and a geom that stands still in each world; its foot touches the ground."""


def differences(place: str, one: Any, other: Any, seen: set[int]) -> Iterator[str]:
    """Where two values differ: in values, types, shapes, strides or in what they hold."""
    if id(one) in seen or isinstance(one, wp.Mesh | wp.Bvh) or callable(one):
        return
    if not isinstance(one, int | float | str):
        seen.add(id(one))
    if isinstance(one, Mapping):
        one, other = dict(one), dict(other)
    if type(one) is not type(other):
        yield f"{place}: {type(one)} and {type(other)}"
    elif isinstance(one, wp.array):
        marks = [(x.dtype, x.shape, x.strides, x.device, getattr(x, "_is_batched", None)) for x in (one, other)]
        values = [x.numpy() for x in (one, other)]
        if one.dtype is wp.uint64:  # addresses: which are equal, and which 0
            values = [x[:, None] == [*x, 0] for x in values]
        if marks[0] != marks[1] or values[0].tobytes() != values[1].tobytes():
            yield f"{place}: {marks}"
    elif isinstance(one, np.ndarray):
        marks = [(x.dtype, x.shape, x.strides, x.flags.writeable, x.tobytes()) for x in (one, other)]
        if marks[0] != marks[1]:
            yield f"{place}: {one} and {other}"
    elif isinstance(one, dict) or (hasattr(one, "__dict__") and not isinstance(one, type)):
        members = [x if isinstance(x, dict) else vars(x) for x in (one, other)]
        if [*members[0]] != [*members[1]]:
            yield f"{place}: {members[0].keys() ^ members[1].keys()}, or their order"
        for name in members[0].keys() & members[1].keys():
            yield from differences(f"{place}.{name}", members[0][name], members[1][name], seen)
    elif isinstance(one, list | tuple):
        if len(one) != len(other):
            yield f"{place}: lengths {len(one)} and {len(other)}"
        for index, pair in enumerate(zip(one, other, strict=False)):
            yield from differences(f"{place}[{index}]", *pair, seen)
    elif type(one).__module__.startswith("mujoco."):
        for name in (name for name in dir(one) if isinstance(getattr(one, name), np.ndarray)):
            yield from differences(f"{place}.{name}", getattr(one, name), getattr(other, name), seen)
    elif "__eq__" in {name for each in type(one).__mro__[:-1] for name in vars(each)} and one != other and one == one:
        yield f"{place}: {one} and {other}"


@pytest.fixture
def both(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], Any]], list[Any]]:
    """Calls a function with worlds that are tiled, and then with worlds built one by one."""
    for name in ("", "_like"):  # what is never written has no values to compare
        monkeypatch.setattr(wp, f"empty{name}", getattr(wp, f"zeros{name}"))

    def call(make: Callable[[], Any]) -> list[Any]:
        monkeypatch.setattr(tiling, "BY_NEWTON", 0)
        tiled = make()
        with monkeypatch.context() as patch:
            patch.setattr(worlds, "tiled", lambda scene, count, device: scene(count).finalize(device=device))
            patch.setattr(Solver, "import_mujoco", SolverMuJoCo.import_mujoco)
            patch.setattr(Solver, "_init_actuators", SolverMuJoCo._init_actuators)
            return [tiled, make()]

    return call


def build(world: newton.ModelBuilder, **options: Any) -> worlds.Worlds:
    return worlds.Worlds(world, COUNT, "cpu", timestep=0.002, substeps=3, fastest=1e3, **options)


def assert_same(tiled: worlds.Worlds, one_by_one: worlds.Worlds) -> None:
    for name in ("model", "solver", "state", "control", "drives", "arrays"):
        assert [*differences(name, getattr(one_by_one, name), getattr(tiled, name), set())] == []


@needs_mjlab
@pytest.mark.filterwarnings("error:the worlds are built one by one")
@pytest.mark.parametrize("name", TASKS)
def test_the_worlds_of_every_task_are_those_built_one_by_one(name: str, both: Any) -> None:
    kind: Any = find_task(name)
    task = kind.sketch(kind.config_type())
    assert_same(*both(lambda: build(task._template(), ground=task.stands_on(), solver_options=task.solver_options)))


@pytest.mark.filterwarnings("error:the worlds are built one by one")
def test_drives_carriers_tendons_equalities_and_standing_geoms_are_those_built_one_by_one(both: Any) -> None:
    motors = EffortActuator("[ab]", delay=2), ExplicitPDActuator("[cd]", 20.0, 1.0, effort_limit=5.0, delay=1)
    robot, options = Robot(MIXED, actuators=motors), {"nconmax": 20}
    tiled, one_by_one = both(lambda: build(template(robot), ground=True, solver_options=options))
    assert tiled.solver.mj_data.ncon and tiled.drives
    assert_same(tiled, one_by_one)
    for each in (tiled, one_by_one):
        each.drives.controls.fill_(0.3)
        each.simulate()
    assert_same(tiled, one_by_one)


@pytest.mark.filterwarnings("error:the worlds are built one by one")
def test_a_task_with_tiled_worlds_randomizes_renders_and_steps_as_one_with_worlds_built_one_by_one(both: Any) -> None:
    kind: Any = find_task("CartpolePixels")

    def stepped() -> dict[str, torch.Tensor]:
        task = kind(kind.config_type(), COUNT, seed=3, device="cpu")
        for _ in range(3):
            task.step(torch.full_like(task.actions, 0.5))
        return {**task.state_dict(), "images": task.observations.clone()}

    tiled, one_by_one = both(stepped)
    assert tiled.keys() == one_by_one.keys()
    assert all(torch.equal(tiled[name], one_by_one[name]) for name in tiled)


@pytest.mark.parametrize("attribute", ["shape_color", "shape_collision_group"])
def test_a_scene_that_follows_no_rule_is_built_one_by_one_after_a_warning(
    attribute: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiling, "BY_NEWTON", 0)

    def scene(count: int) -> newton.ModelBuilder:
        world, builder = empty_builder(), empty_builder()
        world.add_shape_sphere(world.add_body(mass=1.0), radius=0.1)
        builder.replicate(world, count)
        box = builder.add_shape_box(
            -1, color=None if attribute == "shape_color" else (0, 0, 0)
        )  # by the shape's number
        builder.shape_collision_group[box] = count**2 if attribute == "shape_collision_group" else 1
        return builder

    with pytest.warns(UserWarning, match=rf"one by one, which takes long: model\.{attribute} differs"):
        model = tiling.tiled(scene, 4, "cpu")
    expected = scene(4).finalize(device="cpu")
    np.testing.assert_array_equal(getattr(model, attribute).numpy(), getattr(expected, attribute).numpy())


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.float64])
def test_an_array_is_filled_with_copies_of_rows(dtype: Any) -> None:
    rows = np.arange(15, dtype=dtype).reshape(5, 3)
    target = wp.zeros((20, 3), dtype=wp.dtype_from_numpy(dtype), device="cpu")
    tiling.fill(target[5:], wp.array(rows, device="cpu"))
    assert target.numpy().tolist() == [[0, 0, 0]] * 5 + rows.tolist() * 3
