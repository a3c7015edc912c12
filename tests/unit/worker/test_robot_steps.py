"""A world's own step of a robot is MuJoCo's, where values are derived and no single field of a file shows them."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from tests.support.worker.robot_texts import BOX, HINGE, SECOND, mjcf, read, twins
from worker.simulation.robot import Robot
from worker.simulation.robot_elements import empty_builder
from worker.simulation.solver import Solver
from worker.simulation.worlds import Worlds

ARMATURES = {
    "of a motor": mjcf(HINGE + BOX + SECOND, '<actuator><motor joint="j" gear="2" armature=".2"/></actuator>'),
    "of a servo, by a class": mjcf(
        HINGE + BOX + SECOND,
        '<actuator><position joint="j" class="q"/></actuator>',
        '<default><default class="q"><position kp="9" damping="1" armature=".2"/></default></default>',
    ),
    "of a tendon's motor": mjcf(
        HINGE + BOX + SECOND,
        '<tendon><fixed name="f"><joint joint="j" coef="1"/><joint joint="k" coef="-1.5"/></fixed></tendon>'
        '<actuator><motor tendon="f" gear="2" damping="1" armature=".2"/></actuator>',
    ),
    "where the file is rewritten": mjcf(
        f'{HINGE}<joint name="i" axis="1 0 0" pos="0 0 .1"/>{BOX}',
        '<actuator><motor joint="j" gear="2" damping="1" armature=".2"/></actuator>',
    ),
}
GROUND = '<geom type="box" size="1 1 .1"/>'
SOFT = {
    "a slider pressed on a box": (
        f'{GROUND}<body pos="0 0 .3"><joint name="x" type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body>',
        "",
        -2000.0,
    ),
    "a hinge through its centre of mass pressed on a box": (
        f'{GROUND}<body pos="0 0 .3"><joint name="x" axis="0 1 0"/><inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/>'
        '<geom size=".1" pos=".5 0 0"/></body>',
        "",
        50.0,
    ),
    "a slider that a weld holds": (
        '<body name="b" pos="0 0 .3"><joint name="x" type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body>',
        '<equality><weld body1="b"/></equality>',
        200.0,
    ),
    "a slider that follows a mocap body": (
        '<body name="m" mocap="true" pos="0 0 .4"/><body name="b" pos="0 0 .3">'
        '<joint name="x" type="slide" axis="0 0 1"/><geom size=".1" mass="1"/></body>',
        '<equality><weld body1="m" body2="b" relpose="0 0 0 1 0 0 0"/></equality>',
        50.0,
    ),
    "a slider that an arm pulls": (
        '<body name="b" pos="0 0 .3"><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1" contype="0"'
        f' conaffinity="0"/></body><body name="a" pos="0 0 .6">{HINGE}{BOX}</body>',
        '<equality><connect body1="a" body2="b" anchor="0 0 -.3"/></equality>',
        5.0,
    ),
}
"""Bodies of the world, equalities, and the force of a motor on the joint x."""


def stepped(file: str, control: float) -> tuple[Any, Any]:
    """Coordinates of a file's joints after half a second, of a world's own step and of MuJoCo's."""
    builder = empty_builder()
    reading = Robot(file, passive=True).add_to(builder)
    options = {"njmax": 50, "nconmax": 20}
    worlds = Worlds(builder, 2, "cpu", timestep=0.002, substeps=250, fastest=1e9, solver_options=options)
    worlds.restore_defaults()
    worlds.arrays.controls.fill_(control)
    worlds.simulate()
    model = mujoco.MjModel.from_xml_string(file)
    model.opt.timestep, model.opt.integrator = 0.002, worlds.solver.mj_model.opt.integrator
    data = mujoco.MjData(model)
    data.ctrl[:] = control
    for _ in range(250):
        mujoco.mj_step(model, data)
    existing, here = twins(reading).columns()
    return worlds.solver.mjw_data.qpos.numpy()[:, here], data.qpos[existing]


@pytest.mark.parametrize("file", ARMATURES.values(), ids=ARMATURES)
def test_an_actuators_armature_slows_the_joint_in_a_world_as_in_mujoco(file: str) -> None:
    here, existing = stepped(file, 0.5)
    without = stepped(file.replace('armature=".2"', ""), 0.5)[1]
    assert np.abs(without - existing).max() > 5e-3
    np.testing.assert_allclose(here, [existing, existing], atol=1e-5)


@pytest.mark.parametrize(("bodies", "equalities", "control"), SOFT.values(), ids=SOFT)
def test_contacts_and_equalities_of_bodies_that_only_slide_are_as_soft_as_in_mujoco(
    bodies: str, equalities: str, control: float
) -> None:
    text = f'<mujoco><worldbody>{bodies}</worldbody>{equalities}<actuator><motor joint="x"/></actuator></mujoco>'
    here, existing = stepped(text, control)
    np.testing.assert_allclose(here, [existing, existing], atol=5e-4)


@pytest.mark.parametrize("options", ['density="100" wind="3 0 0"', 'actuatorgroupdisable="0"'])
def test_accelerations_are_compared_under_the_options_that_the_robot_has(options: str) -> None:
    assert read(mjcf(HINGE + BOX, before=f"<option {options}/>"), file_options=False).lines() == []


@pytest.mark.parametrize("flag", ["actuation", "spring", "gravity"])
def test_flags_that_a_task_leaves_out_do_not_refuse_a_robot(flag: str) -> None:
    spring = HINGE.replace("/>", ' stiffness="5" springref="40"/>')
    file = mjcf(spring + BOX, before=f'<option><flag {flag}="disable"/></option>')
    assert read(file, file_options=False).lines() == []


def test_a_noslip_solver_does_not_refuse_a_robot() -> None:
    joint = HINGE.replace("/>", ' frictionloss="1"/>')
    reading = read(mjcf(joint + BOX, before='<option noslip_iterations="20"/>'))
    assert not reading.corrected
    assert any("noslip" in note for note in reading.notes)


def test_a_value_that_is_not_stepped_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Solver, "_add_rotors", lambda *_: None)
    with pytest.raises(ValueError, match=r"joint j: armature is 0, in the file 0\.8"):
        read(ARMATURES["of a motor"])


MESH = '<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1 1 1 1"/></asset>'
SPRING = HINGE.replace("/>", ' springdamper=".1 1"/>')
"""A joint for which a file is rewritten."""


@pytest.mark.parametrize("joint", [HINGE, SPRING], ids=["as it is", "rewritten"])
@pytest.mark.parametrize(("flag", "is_on"), [("", False), ('<option><flag multiccd="enable"/></option>', True)])
def test_a_file_that_enables_multiccd_keeps_it_and_another_gets_a_note(joint: str, flag: str, is_on: bool) -> None:
    table = '<worldbody><geom name="table" type="box" size="1 1 .1"/></worldbody>'
    reading = read(mjcf(f'{joint}<geom name="stone" type="mesh" mesh="m"/>', table, before=flag + MESH))
    assert bool(reading.corrected) == (joint == SPRING)
    assert bool(twins(reading).built.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)) != is_on
    assert any("enable_multiccd" in note and "geom stone" in note for note in reading.notes) != is_on


def test_a_robot_without_such_contacts_has_no_note_of_multiccd() -> None:
    assert not read(mjcf(f'{HINGE}<geom type="box" size=".1 .1 .1"/><geom size=".1"/>')).notes
    assert not read(mjcf(f'{HINGE}<geom type="mesh" mesh="m"/>', before=MESH)).notes, "it touches the ground alone"


def test_a_force_beyond_newtons_limit_is_named() -> None:
    with pytest.raises(ValueError, match=r"joint j: greatest force of actuators is 1e\+06.*choose smaller gears"):
        read(mjcf(HINGE + BOX, '<actuator><motor joint="j" gear="5e6"/></actuator>'))
