"""Contact sensors against MuJoCo's own engine: forces, what counts, times, what a control step's history holds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from tests.support.refusals import refusal
from tests.support.worker.sensing import Reference, scene, step, walker
from worker.simulation.capture import CapturedStep
from worker.simulation.sensors.contact import (
    ContactArrays,
    ContactSensor,
    first_air,
    first_contact,
    steps_above,
    strongest_contact,
)

CONTROLS = np.array([[0.3, -0.4], [-0.2, 0.2]], np.float32)
"""Torques of the walker's legs in two worlds."""
Found = list[tuple[str, str, np.ndarray]]
BALL = """<mujoco><worldbody><body name="ball" pos="0 0 0.12"><freejoint/>
  <geom name="ball" type="sphere" size="0.05" mass="0.5" solref="-4000 -3"/>
  <body name="arm"><joint name="arm" axis="0 1 0"/><geom name="arm" type="sphere" size="0.01" pos="0 0 0.2" mass="0.01"
    contype="0" conaffinity="0"/></body></body></worldbody>
  <actuator><motor name="arm" joint="arm"/></actuator></mujoco>"""
"""It bounces: a spring under it with little damping."""
BOX = """<mujoco><worldbody><body name="box" pos="{} 0 0.35"><freejoint/>
  <geom name="box" type="box" size="0.1 0.1 0.1" mass="1"/></body></worldbody></mujoco>"""


def on_geoms(contacts: Found, mine: set[str], others: set[str]) -> tuple[int, np.ndarray, float]:
    """Number of contacts between two sets of geoms, the net force on the first set, and the norm of the strongest contact."""
    force, strengths = np.zeros(3), [0.0]
    for one, two, on_two in contacts:
        hit_one, hit_two = one in mine and two in others, two in mine and one in others
        force += on_two * (int(hit_two) - int(hit_one))
        strengths += [float(np.linalg.norm(on_two))] * (hit_one or hit_two)
    return len(strengths) - 1, force, max(strengths)


@pytest.mark.parametrize(("cone", "condim"), [("pyramidal", 1), ("pyramidal", 3), ("pyramidal", 6), ("elliptic", 6)])
def test_forces_are_those_of_mj_contact_force_in_two_worlds_that_differ(cone: str, condim: int) -> None:
    text = walker().replace("<worldbody>", f'<default><geom condim="{condim}"/></default><worldbody>', 1)
    context = scene({"robot": text}, cone=cone)
    sensor = ContactSensor(geoms=["*_foot", "toe"]).build(context)
    assert sensor.names == ("left_foot", "toe", "right_foot")
    assert set(context.worlds.solver.mj_model.geom_condim) == {condim}
    reference = Reference(text, cone=["pyramidal", "elliptic"].index(cone))
    context.worlds.arrays.controls.assign(CONTROLS)
    most = np.zeros((2, 3))
    for _ in range(60):
        expected = []
        for world in range(2):
            reference.take(context, world)
            contacts = reference.contacts()
            expected.append([on_geoms(contacts, {name}, {"floor"}) for name in sensor.names])
        step(context, sensor)
        forces, found = sensor.arrays.forces.numpy(), sensor.arrays.found.numpy()
        for world in range(2):
            for column in range(3):
                count, force, strongest = expected[world][column]
                assert found[world, column] == count
                np.testing.assert_allclose(forces[world, column], force, rtol=5e-3, atol=0.1)
                assert sensor.arrays.history.numpy()[world, column, 0] == pytest.approx(strongest, rel=5e-3, abs=0.1)
                most[world, column] = max(most[world, column], np.linalg.norm(force))
        np.testing.assert_array_equal(sensor.arrays.peaks.numpy(), np.linalg.norm(forces, axis=-1).astype(np.float32))
    assert most[:, [0, 2]].min() > 1 and not np.allclose(most[0], most[1], rtol=0.05), most


def test_contacts_of_a_robot_with_itself() -> None:
    context = scene({"robot": walker(2.0)})
    together = ContactSensor(bodies="*", against="robot", together=True).build(context)
    legs = ContactSensor(bodies=["left", "right"], against="robot").build(context)
    assert together.names == ("robot",) and legs.names == ("left", "right")
    reference = Reference(walker(2.0))
    context.worlds.arrays.controls.assign(np.array([[0.0, 1.0], [0.0, 0.0]], np.float32))
    everything = {"trunk", "left_leg", "left_foot", "toe", "right_leg", "right_foot"}
    met = 0
    for _ in range(80):
        reference.take(context, 0)
        contacts = reference.contacts()
        count, _, strongest = on_geoms(contacts, everything, everything)
        sides = ({"left_leg", "left_foot"}, {"right_leg", "right_foot"})
        on_legs = [on_geoms(contacts, side, everything)[1] for side in sides]
        step(context, together, legs)
        assert together.arrays.found.numpy().tolist() == [[count], [0]]
        assert together.arrays.history.numpy()[0, 0, 0] == pytest.approx(strongest, rel=5e-3, abs=0.05)
        assert not together.arrays.forces.numpy().any()
        np.testing.assert_allclose(legs.arrays.forces.numpy()[0], on_legs, rtol=5e-3, atol=0.05)
        met += count
    assert met > 3


@wp.kernel
def ask(contacts: ContactArrays, threshold: float, answers: wp.array2d[wp.float32]):
    world = wp.tid()
    answers[world, 0] = float(int(first_contact(contacts, world, 0)))
    answers[world, 1] = float(int(first_air(contacts, world, 0)))
    answers[world, 2] = float(steps_above(contacts, world, 0, threshold))
    answers[world, 3] = strongest_contact(contacts, world, 0)


def answers_of(contacts: ContactArrays, threshold: float) -> list[list[float]]:
    answers = wp.zeros((contacts.found.shape[0], 4), dtype=wp.float32, device="cpu")
    wp.launch(ask, dim=answers.shape[0], inputs=[contacts, threshold, answers], device="cpu")
    return answers.numpy().tolist()


class Clock:
    """Times in the air and in contact, by hand, from whether there was a contact in each measurement."""

    def __init__(self, length: float) -> None:
        self.length, self.air, self.contact, self.last_air, self.last_contact = length, 0.0, 0.0, 0.0, 0.0

    def tick(self, touches: bool) -> None:
        if touches:
            self.last_air = self.air + self.length if self.air else self.last_air
            self.air, self.contact = 0.0, self.contact + self.length
        else:
            self.last_contact = self.contact + self.length if self.contact else self.last_contact
            self.air, self.contact = self.air + self.length, 0.0

    def check(self, arrays: ContactArrays, world: int) -> None:
        fields = (arrays.air_time, arrays.contact_time, arrays.last_air_time, arrays.last_contact_time)
        measured = [field.numpy()[world, 0] for field in fields]
        np.testing.assert_allclose(
            measured, [self.air, self.contact, self.last_air, self.last_contact], rtol=1e-5, atol=1e-6
        )


def test_a_bouncing_ball_in_every_physics_step_and_in_every_control_step() -> None:
    floor = '<mujoco><worldbody><geom name="floor" type="plane" size="5 5 0.1"/>'
    text = BALL.replace("<mujoco><worldbody>", floor)
    context = scene({"robot": text}, substeps=4, timestep=0.005)
    for coordinates in (context.worlds.arrays.joint_q, context.worlds.solver.mjw_data.qpos):
        higher = coordinates.numpy()
        higher[1, 2] += 0.3
        coordinates.assign(higher)
    fine = ContactSensor(bodies="ball", fine=True).build(context)
    coarse = ContactSensor(bodies="ball").build(context)
    reference = Reference(text, timestep=0.005)
    seen: list[list[tuple[int, np.ndarray, float]]] = []

    def look() -> None:
        seen.append([])
        for world in range(2):
            reference.take(context, world)
            seen[-1].append(on_geoms(reference.contacts(), {"ball"}, {"floor"}))

    # the callback comes after a physics step: what it sees is what the next one begins with
    look()
    context.worlds.after_substep.append(look)
    clocks = [[Clock(0.005), Clock(0.02)] for _ in range(2)]
    landings = [0, 0]
    for _ in range(60):
        step(context, fine, coarse)
        started, answers = seen[:-1], answers_of(fine.arrays, 5.0)
        del seen[:-1]
        assert len(started) == 4
        for world in range(2):
            by_hand, by_control_step = clocks[world]
            before = by_hand.contact, by_hand.air
            for substep in started:
                by_hand.tick(substep[world][0] > 0)
            by_control_step.tick(started[-1][world][0] > 0)
            by_hand.check(fine.arrays, world)
            by_control_step.check(coarse.arrays, world)
            strongest = [substep[world][2] for substep in reversed(started)]
            np.testing.assert_allclose(fine.arrays.history.numpy()[world, 0], strongest, rtol=5e-3, atol=0.05)
            assert fine.arrays.peaks.numpy()[world, 0] == pytest.approx(max(strongest), rel=5e-3, abs=0.05)
            landed = before[0] == 0 and by_hand.contact > 0
            left = before[1] == 0 and by_hand.air > 0
            assert answers[world][:2] == [landed, left]
            assert answers[world][2] == sum(force > 5.0 for force in strongest)
            assert answers[world][3] == pytest.approx(max(strongest), rel=5e-3, abs=0.05)
            landings[world] += landed
    assert min(landings) > 1 and landings[0] != landings[1], landings


def test_a_world_that_was_placed_afresh_forgets_and_the_other_does_not() -> None:
    context = scene({"robot": walker()}, substeps=2)
    sensor = ContactSensor(geoms="*_foot", fine=True).build(context)
    for _ in range(60):
        step(context, sensor)
        if sensor.arrays.found.numpy().any(1).all() and sensor.arrays.air_time.numpy().any(1).all():
            break  # one foot of each world stands, the other one doesn't
    before = {name: tensor.clone() for name, tensor in sensor.state_tensors().items()}
    assert all(tensor[world].any() for name, tensor in before.items() for world in range(2) if "last_c" not in name)
    context.episodes.ages.assign(np.array([0, 7], np.int32))
    sensor.settle()
    for name, tensor in sensor.state_tensors().items():
        assert not tensor[0].any() and torch.equal(tensor[1], before[name][1]), name


def test_its_state_goes_on_in_another_sensor_and_a_recorded_step_measures_the_same() -> None:
    contexts = [scene({"robot": walker()}, substeps=2) for _ in range(2)]
    declared = ContactSensor(bodies=["left", "right"], fine=True)
    one, two = [declared.build(context) for context in contexts]
    for _ in range(25):
        step(contexts[0], one)
    step(contexts[1], two)  # loads every kernel
    captured = CapturedStep(lambda: step(contexts[1], two), "cpu")
    for name in ("joint_q", "joint_qd", "warm_start"):
        source = getattr(contexts[0].worlds.arrays, name).numpy()
        getattr(contexts[1].worlds.arrays, name).assign(source)
    saved, loaded = one.state_tensors(), two.state_tensors()
    for name, tensor in saved.items():
        loaded[name].copy_(tensor)
    for _ in range(10):
        step(contexts[0], one)
        captured.launch()
        for name, tensor in saved.items():
            assert torch.equal(loaded[name], tensor), name
    assert saved["contact_time"].max() > 0.1


def test_what_is_touched_may_be_the_ground_an_object_or_anything() -> None:
    shelf = BOX.format(0.0).replace("<freejoint/>", "")  # fixed to the world
    context = scene({"robot": BALL, "near": BOX.format(0.05), "far": BOX.format(2.0)}, ground=True)
    names: list[str | None] = ["ground", "near", "far", None]
    sensors = {name: ContactSensor(bodies="ball", against=name).build(context) for name in names}
    of_box = ContactSensor(bodies="box", robot="near", against="robot").build(context)
    totals: dict[str | None, int] = dict.fromkeys(names, 0)
    for _ in range(80):
        step(context, *sensors.values(), of_box)
        counts = {name: int(sensor.arrays.found.numpy()[0, 0]) for name, sensor in sensors.items()}
        assert counts[None] == sum(counts[name] for name in names if name is not None)
        np.testing.assert_allclose(
            of_box.arrays.forces.numpy(), -sensors["near"].arrays.forces.numpy(), rtol=1e-5, atol=1e-5
        )
        for name in names:
            totals[name] += counts[name]
    assert totals["ground"] > 0 and totals["near"] > 0 and totals["far"] == 0, totals
    fixed = scene({"robot": BALL.replace("0 0 0.12", "0 0 0.51"), "shelf": shelf}, ground=True)
    on_shelf, on_ground = (ContactSensor(bodies="ball", against=name).build(fixed) for name in ("shelf", "ground"))
    for _ in range(60):
        step(fixed, on_shelf, on_ground)
    assert on_shelf.arrays.last_air_time.numpy().min() > 0 and not on_ground.arrays.contact_time.numpy().any()


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ({}, ["either bodies or geoms"]),
        ({"bodies": "left", "geoms": "left_leg"}, ["either bodies or geoms"]),
        ({"geoms": "*_fot"}, ["no geom of robot matches '*_fot'", "left_foot"]),
        ({"bodies": "lefd"}, ["no body of robot matches 'lefd'", "did you mean left?"]),
        (
            {"bodies": "left", "robot": "robbot"},
            ["ContactSensor.robot: there is no robot 'robbot'; did you mean robot?"],
        ),
        (
            {"bodies": "left", "against": "grund"},
            ["against: there is no 'grund'; did you mean ground?", "None: anything"],
        ),
        ({"geoms": []}, ["no pattern for a geom of robot was given"]),
        ({"bodies": ["left", "mast"]}, ["mast of robot has no geom that can collide", "left_foot"]),
    ],
)
def test_a_sensor_that_can_t_be_built_is_refused_in_one_line(arguments: dict[str, Any], parts: list[str]) -> None:
    mast = '<body name="mast"><joint name="mast" axis="0 0 1"/><geom name="mast" size="0.01" contype="0" conaffinity="0"/></body>'
    text = walker().replace('<body name="left"', mast + '<body name="left"', 1)
    context = scene({"robot": text}, 1)
    assert "mast" not in ContactSensor(bodies="*").build(context).names
    output = refusal(ContactSensor(**arguments).build, context)
    assert all(part in output for part in parts), output


def test_nothing_to_stand_on_and_a_solver_without_contacts_are_refused() -> None:
    context = scene({"robot": BALL}, 1)
    with pytest.raises(ValueError, match=r"against: nothing of 'ground' can collide; "):
        ContactSensor(bodies="ball").build(context)
    context = scene({"robot": BALL}, 1, ground=True, disable_contacts=True)
    with pytest.raises(ValueError, match=r"the solver computes no contacts; give solver_options nconmax"):
        ContactSensor(bodies="ball").build(context)
