"""Every randomised quantity does in Newton's worlds what it does in MuJoCo's own engine where it is set by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import mujoco
import newton
import numpy as np
import pytest
from newton.solvers import SolverMuJoCo

from tests.support.worker.randomized_worlds import ARM, TIMESTEP, WORLDS, build_arm, build_worlds, randomize
from worker.simulation.actuators import ExplicitPDActuator
from worker.simulation.robot import Robot
from worker.simulation.robot_view import RobotView
from worker.simulation.worlds import Worlds
from worker.tasks.randomize import Randomize

PAYLOAD_AT = (0.1, 0.05, 0.02)
SLED = """<mujoco><worldbody><body name="sled" pos="0 0 0.02"><freejoint/>
  <geom name="hull" type="box" size="0.2 0.1 0.02" pos="0 0 0.05" mass="2" contype="0" conaffinity="0"/>
  <geom name="left" type="sphere" size="0.02" pos="0.15 0.08 0" mass="0.1" friction="0.7 0.005 0.0001" condim="4"/>
  <geom name="right" type="sphere" size="0.02" pos="0.15 -0.08 0" mass="0.1" friction="0.7 0.005 0.0001" condim="4"/>
  <geom name="rear" type="sphere" size="0.02" pos="-0.15 0 0" mass="0.1" friction="0.7 0.005 0.0001" condim="4"/>
</body>{ground}</worldbody>{actuator}</mujoco>"""

Edit = Callable[[mujoco.MjModel, Callable[[str], float]], None]


def run_reference(
    model: mujoco.MjModel, worlds: Worlds, q: np.ndarray, v: np.ndarray, controls: np.ndarray, steps: int
) -> np.ndarray:
    """MuJoCo's own engine from the same state."""
    data = prepared(model, worlds)
    data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, controls
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return data.qpos.copy()


def prepared(model: mujoco.MjModel, worlds: Worlds) -> mujoco.MjData:
    """Data of a model with the solver's settings of the worlds, and with all constants that follow from its numbers."""
    for name in ("integrator", "cone", "impratio", "solver"):
        setattr(model.opt, name, getattr(worlds.solver.mj_model.opt, name))
    model.opt.timestep, model.opt.iterations, model.opt.tolerance = TIMESTEP, 100, 1e-10
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    return data


def joint(model: mujoco.MjModel, name: str) -> int:
    return int(model.joint(name).id)


def set_mass(model: mujoco.MjModel, drawn: Callable[[str], float]) -> None:
    for body in ("upper", "fore"):
        model.body(body).mass *= drawn(f"mass/{body}")
        model.body(body).inertia *= drawn(f"mass/{body}")


def set_center(model: mujoco.MjModel, drawn: Callable[[str], float]) -> None:
    model.body("upper").ipos += [drawn(f"center/upper/{axis}") for axis in "xyz"]


def set_inertia(model: mujoco.MjModel, drawn: Callable[[str], float]) -> None:
    model.body("finger").inertia *= drawn("inertia/finger")
    model.body("upper").inertia *= drawn("inertia/upper")


def set_limits(model: mujoco.MjModel, drawn: Callable[[str], float]) -> None:
    model.joint("shoulder").range += [0.0, drawn("limits/shoulder/upper")]


def per_joint(field: str, name: str, operation: str = "scale") -> Edit:
    def edit(model: mujoco.MjModel, drawn: Callable[[str], float]) -> None:
        values = getattr(model, field)
        for each in ("shoulder", "elbow", "wrist", "slide"):
            dof = model.jnt_dofadr[joint(model, each)]
            values[dof] = values[dof] * drawn(f"{name}/{each}") if operation == "scale" else drawn(f"{name}/{each}")

    return edit


def set_stiffness(model: mujoco.MjModel, drawn: Callable[[str], float]) -> None:
    for actuator, name in ((0, "shoulder"), (3, "slide")):
        model.actuator_gainprm[actuator, 0] = drawn(f"stiffness/{name}")
        model.actuator_biasprm[actuator, 1] = -drawn(f"stiffness/{name}")


def set_damping(model: mujoco.MjModel, drawn: Callable[[str], float]) -> None:
    model.actuator_biasprm[0, 2] -= drawn("damping/shoulder")
    model.actuator_biasprm[1, 2] -= drawn("damping/elbow")
    model.actuator_gainprm[1, 0] += drawn("damping/elbow")


def set_effort(model: mujoco.MjModel, drawn: Callable[[str], float]) -> None:
    model.actuator_forcerange[0] = -drawn("effort/shoulder"), drawn("effort/shoulder")


def set_strength(model: mujoco.MjModel, drawn: Callable[[str], float]) -> None:
    for actuator, name in enumerate(("shoulder", "elbow", "wrist", "slide")):
        model.actuator_gainprm[actuator] *= drawn(f"strength/{name}")
        model.actuator_biasprm[actuator] *= drawn(f"strength/{name}")


def set_gravity(model: mujoco.MjModel, drawn: Callable[[str], float]) -> None:
    model.opt.gravity[0], model.opt.gravity[2] = drawn("gravity/gravity/x"), drawn("gravity/gravity/z") - 9.81


ENTRIES = {
    "mass": Randomize("mass", bodies=("upper", "fore"), range=(0.7, 1.6)),
    "center": Randomize("center_of_mass", bodies="upper", range=(-0.05, 0.05), operation="add"),
    "inertia": Randomize("inertia", bodies=("upper", "finger"), range=(1.5, 3.0)),
    "stretch": Randomize("inertia", bodies="hand", range={"x": (3.0, 5.0)}, shared=True),
    "payload": Randomize("payload", bodies="fore", range=(0.3, 0.6), operation="add", at=PAYLOAD_AT),
    "limits": Randomize("joint_limits", joints="shoulder", range={"upper": (-1.4, -1.0)}, operation="add"),
    "armature": Randomize("armature", joints="*", range=(1.5, 3.0), distribution="log_uniform"),
    "joint_damping": Randomize("joint_damping", joints="*", range=(0.3, 3.0)),
    "joint_friction": Randomize("joint_friction", joints="*", range=(0.05, 0.3), operation="set"),
    "stiffness": Randomize("stiffness", actuators="s*", range=(30.0, 60.0), operation="set"),
    "damping": Randomize("damping", actuators=("shoulder", "elbow"), range=(0.5, 1.5), operation="add"),
    "effort": Randomize("effort_limit", actuators="shoulder", range=(2.0, 5.0), operation="set"),
    "strength": Randomize("motor_strength", actuators="*", range=(0.6, 0.9)),
    "gravity": Randomize("gravity", range={"x": (-3.0, 3.0), "z": (-2.0, 2.0)}, operation="add"),
}
EDITS: Mapping[str, Edit] = {
    "mass": set_mass,
    "center": set_center,
    "inertia": set_inertia,
    "limits": set_limits,
    "armature": per_joint("dof_armature", "armature"),
    "joint_damping": per_joint("dof_damping", "joint_damping"),
    "joint_friction": per_joint("dof_frictionloss", "joint_friction", "set"),
    "stiffness": set_stiffness,
    "damping": set_damping,
    "effort": set_effort,
    "strength": set_strength,
    "gravity": set_gravity,
}


def arm_model(drawn: Callable[[str], float], without: str = "") -> mujoco.MjModel:
    """The arm as MuJoCo compiles it, edited by hand: payload and stretched hand are geoms in its file."""
    load = drawn("payload/fore") if without != "payload" else 1e-9
    longer = np.sqrt(drawn("stretch/x")) if without != "stretch" else 1.0
    at = " ".join(map(str, PAYLOAD_AT))
    geom = f'<geom type="sphere" size="0.0001" pos="{at}" mass="{load}"/>'
    model = mujoco.MjModel.from_xml_string(ARM.format(load="", hand=0.04 * longer))
    for name, edit in EDITS.items():
        if name != without and name != "mass":
            edit(model, drawn)
    # The mass is scaled before the payload is added.
    factor = drawn("mass/fore") if without != "mass" else 1.0
    heavier = mujoco.MjModel.from_xml_string(
        ARM.replace('mass="0.8"', f'mass="{0.8 * factor}"').format(load=geom, hand=0.04)
    )
    fore, body = model.body("fore"), heavier.body("fore")
    fore.mass, fore.ipos, fore.iquat, fore.inertia = body.mass, body.ipos, body.iquat, body.inertia
    if without != "mass":
        model.body("upper").mass *= drawn("mass/upper")
        model.body("upper").inertia *= drawn("mass/upper")
    return model


def test_an_arm_moves_as_in_mujoco_and_every_quantity_has_its_share() -> None:
    worlds, view = build_arm()
    randomizations = randomize(ENTRIES, worlds, view)
    generator = np.random.default_rng(3)
    q = np.array([0.4, 0.5, -0.6, 0.0]) + generator.uniform(-0.04, 0.04, (WORLDS, 4))
    v = generator.uniform(-1, 1, (WORLDS, 4)) * [1, 1, 1, 0.2]
    controls = np.array([[0.9, -0.5, 0.3, 0.02], [-1.5, 1.5, -0.2, -0.03]])
    for array, values in ((worlds.arrays.joint_q, q), (worlds.arrays.joint_qd, v), (worlds.arrays.controls, controls)):
        array.assign(values.astype(np.float32))
    steps = 100
    for _ in range(steps):
        worlds.simulate()
    got = worlds.arrays.joint_q.numpy()
    shares = dict.fromkeys(ENTRIES, 0.0)
    for world in range(WORLDS):
        row = randomizations.draws[world].tolist()
        drawn = dict(zip(randomizations.names, row, strict=True)).__getitem__
        expected = run_reference(arm_model(drawn), worlds, q[world], v[world], controls[world], steps)
        np.testing.assert_allclose(got[world], expected, atol=1e-4)
        for name in ENTRIES:
            other = run_reference(arm_model(drawn, name), worlds, q[world], v[world], controls[world], steps)
            shares[name] = max(shares[name], float(np.abs(other - expected).max()))
    assert {name: share for name, share in shares.items() if share < 5e-4} == {}


def test_what_mujoco_derives_from_masses_follows() -> None:
    worlds, view = build_arm()
    randomizations = randomize(ENTRIES, worlds, view)
    for world in range(WORLDS):
        drawn = dict(zip(randomizations.names, randomizations.draws[world].tolist(), strict=True)).__getitem__
        model = arm_model(drawn)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        for name in ("body_subtreemass", "body_invweight0", "dof_invweight0"):
            got = getattr(worlds.solver.mjw_model, name).numpy()[world]
            np.testing.assert_allclose(got, getattr(model, name), rtol=2e-4, err_msg=name)


def sled_worlds() -> tuple[Worlds, RobotView]:
    text = SLED.format(ground="", actuator='<actuator><motor name="none" joint="sled_freejoint"/></actuator>')
    text = text.replace("<freejoint/>", '<freejoint name="sled_freejoint"/>')
    return build_worlds(text, ground=True, njmax=40, nconmax=8)


@pytest.mark.parametrize("operation", ["scale", "set"])
def test_a_sled_slides_as_in_mujoco(operation: str) -> None:
    worlds, view = sled_worlds()
    own = worlds.solver.mjw_model.geom_friction.numpy()[0].copy()
    ends = (0.3, 0.9) if operation == "scale" else (0.2, 0.6)
    entries = {
        "ground": Randomize("friction", geoms="ground_plane", range=(0.01, 0.02), operation="set", robot=None),
        "feet": Randomize(
            "friction",
            geoms=("left", "right", "rear"),
            range={"slide": ends, "torsion": (0.5, 4.0)},
            operation=operation,
        ),
        "gravity": Randomize("gravity", range=(0.5, 0.9)),
    }
    randomizations = randomize(entries, worlds, view)
    changed = worlds.solver.mjw_model.geom_friction.numpy()
    assert changed.shape[1] == len(own) and not np.allclose(changed[0], changed[1])
    velocity = np.array([[1.2, 0.4, 0, 0, 0, 1.5], [0.8, -0.7, 0, 0, 0, -2.0]])
    steps, moved = 60, []
    center = worlds.model.body_com.numpy()
    q = np.tile([0, 0, 0.0199, 1, 0, 0, 0], (WORLDS, 1))
    joint_q = np.tile([0, 0, 0.0199, 0, 0, 0, 1], (WORLDS, 1))
    # Newton's velocity is that of the centre of mass, MuJoCo's that of the body's origin.
    linear = velocity[:, :3] + np.cross(velocity[:, 3:], center[:WORLDS])
    worlds.arrays.joint_q.assign(joint_q.astype(np.float32))
    worlds.arrays.joint_qd.assign(np.hstack([linear, velocity[:, 3:]]).astype(np.float32))
    for _ in range(steps):
        worlds.simulate()
    for world in range(WORLDS):
        drawn = dict(zip(randomizations.names, randomizations.draws[world].tolist(), strict=True)).__getitem__
        model = mujoco.MjModel.from_xml_string(
            SLED.format(ground='<geom name="floor" type="plane" size="0 0 1"/>', actuator="")
        )
        model.geom("floor").friction = [drawn("ground/ground_plane/slide"), *own[-1][1:]]
        for foot in ("left", "right", "rear"):
            for index, axis in enumerate(("slide", "torsion")):
                number = drawn(f"feet/{foot}/{axis}")
                model.geom(foot).friction[index] = number * (
                    model.geom(foot).friction[index] if operation == "scale" else 1
                )
        model.opt.gravity[2] *= drawn("gravity/gravity/z")
        expected = run_reference(model, worlds, q[world], velocity[world], np.zeros(0), steps)
        got = worlds.arrays.joint_q.numpy()[world]
        np.testing.assert_allclose(got[[0, 1, 2, 6, 3, 4, 5]], expected, atol=3e-4)
        unchanged = mujoco.MjModel.from_xml_string(
            SLED.format(ground='<geom name="floor" type="plane" size="0 0 1"/>', actuator="")
        )
        other = run_reference(unchanged, worlds, q[world], velocity[world], np.zeros(0), steps)
        moved.append(np.abs(other - expected).max())
    assert min(moved) > 0.01


CUBE = """<mujoco><worldbody><body name="cube" pos="0 0 1"><freejoint name="free"/>{inertial}
  <geom type="box" size="0.1 0.07 0.05" contype="0" conaffinity="0" mass="2"/></body>
</worldbody>{actuator}</mujoco>"""


def test_an_object_alone_on_its_joint_tumbles_about_its_new_center() -> None:
    """MuJoCo keeps the mass matrix of such a body diagonal where the file puts its centre of mass at its origin."""
    actuator = '<actuator><motor joint="free"/></actuator>'
    worlds, view = build_worlds(CUBE.format(inertial="", actuator=actuator), njmax=10, nconmax=2)
    own = worlds.solver.mjw_model.body_inertia.numpy()[0, 1]
    entry = Randomize("center_of_mass", bodies="cube", range=(-0.04, 0.04), operation="add")
    center = randomize({"center": entry}, worlds, view).draws.double().numpy()
    velocity = np.array([0.3, -0.2, 2.0, 3.0, -4.0, 5.0])
    linear = velocity[:3] + np.cross(velocity[3:], center)  # Newton's is that of the centre of mass
    start = np.tile([0, 0, 1, 0, 0, 0, 1], (WORLDS, 1))
    worlds.arrays.joint_q.assign(start.astype(np.float32))
    worlds.arrays.joint_qd.assign(np.hstack([linear, np.tile(velocity[3:], (WORLDS, 1))]).astype(np.float32))
    for _ in range(60):
        worlds.simulate()
    moments = {"x": 0.07**2 + 0.05**2, "y": 0.1**2 + 0.05**2, "z": 0.1**2 + 0.07**2}  # of a box of 2 kg, times 3 / 2
    diagonal = [2.0 / 3.0 * moment for moment in moments.values()]
    np.testing.assert_allclose(np.sort(own), np.sort(diagonal), rtol=1e-5)
    for world in range(WORLDS):
        at, inertia = (" ".join(map(str, values)) for values in (center[world], diagonal))
        inertial = f'<inertial pos="{at}" mass="2" diaginertia="{inertia}"/>'
        model = mujoco.MjModel.from_xml_string(CUBE.format(inertial=inertial, actuator=""))
        expected = run_reference(model, worlds, np.array([0, 0, 1, 1, 0, 0, 0]), velocity, np.zeros(0), 60)
        got = worlds.arrays.joint_q.numpy()[world]
        np.testing.assert_allclose(got[[0, 1, 2, 6, 3, 4, 5]], expected, atol=1e-4)


def test_explicit_motors_have_the_drawn_gains_and_limits() -> None:
    motors = [ExplicitPDActuator("*", stiffness=12.0, damping=0.6, effort_limit=6.0)]
    template = newton.ModelBuilder()
    SolverMuJoCo.register_custom_attributes(template)
    Robot(ARM.format(load="", hand=0.04), actuators=motors).add_to(template)
    options = {
        "iterations": 50,
        "ls_iterations": 50,
        "tolerance": 1e-8,
        "njmax": 20,
        "nconmax": 0,
        "disable_contacts": True,
    }
    worlds = Worlds(
        template, WORLDS, "cpu", timestep=TIMESTEP, substeps=1, fastest=1e3, ground=False, solver_options=options
    )
    view = RobotView(template)
    entries = {
        "stiffness": Randomize("stiffness", actuators="*", range=(0.5, 2.0)),
        "damping": Randomize("damping", actuators="*", range=(0.1, 0.4), operation="add"),
        "limit": Randomize("effort_limit", actuators="shoulder", range=(2.0, 4.0), operation="set"),
        "strength": Randomize("motor_strength", actuators="elbow", range=(0.5, 0.7)),
    }
    randomizations = randomize(entries, worlds, view)
    targets, start, steps = np.array([-0.5, 0.6, 0.8, 0.02]), np.array([0.2, 0.1, -0.4, 0.0]), 60
    worlds.arrays.controls.assign(np.tile(targets, (WORLDS, 1)).astype(np.float32))
    worlds.arrays.joint_q.assign(np.tile(start, (WORLDS, 1)).astype(np.float32))
    for _ in range(steps):
        worlds.simulate()
    for world in range(WORLDS):
        drawn = dict(zip(randomizations.names, randomizations.draws[world].tolist(), strict=True))
        names = ("shoulder", "elbow", "wrist", "slide")
        kp = 12.0 * np.array([drawn[f"stiffness/{name}"] for name in names])
        kd = 0.6 + np.array([drawn[f"damping/{name}"] for name in names])
        limit, strength = np.array([drawn["limit/shoulder"], 6, 6, 6]), np.array([1, drawn["strength/elbow"], 1, 1])
        text = ARM.format(load="", hand=0.04)
        model = mujoco.MjModel.from_xml_string(text[: text.index("<actuator>")] + "</mujoco>")
        data = prepared(model, worlds)
        data.qpos[:] = start
        saturated = False
        for _ in range(steps):
            force = kp * (targets - data.qpos) - kd * data.qvel
            saturated |= abs(force[0]) > limit[0]
            data.qfrc_applied[:] = strength * np.clip(force, -limit, limit)
            mujoco.mj_step(model, data)
        assert saturated
        np.testing.assert_allclose(worlds.arrays.joint_q.numpy()[world], data.qpos, atol=1e-4)
