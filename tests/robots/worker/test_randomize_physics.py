"""Every randomised quantity does in Newton's worlds what it does in MuJoCo's own engine where it is set by hand."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from tests.support.worker.randomized_worlds import ARM, TIMESTEP, WORLDS, build_arm, build_worlds, randomize
from worker.simulation.actuators import ExplicitPDActuator
from worker.simulation.declared_randomization import Randomize
from worker.simulation.randomizations import Randomizations
from worker.simulation.robot import Robot
from worker.simulation.worlds import Worlds

PAYLOAD_AT = "0.1 0.05 0.02"
SLED = """<mujoco><worldbody><body name="sled" pos="0 0 0.02"><freejoint/>
  <geom name="hull" type="box" size="0.2 0.1 0.02" pos="0 0 0.05" mass="2" contype="0" conaffinity="0"/>
  <geom name="left" type="sphere" size="0.02" pos="0.15 0.08 0" mass="0.1" friction="0.7 0.005 0.0001" condim="4"/>
  <geom name="right" type="sphere" size="0.02" pos="0.15 -0.08 0" mass="0.1" friction="0.7 0.005 0.0001" condim="4"/>
  <geom name="rear" type="sphere" size="0.02" pos="-0.15 0 0" mass="0.1" friction="0.7 0.005 0.0001" condim="4"/>
</body>{ground}</worldbody>{actuator}</mujoco>"""
FLOOR = '<geom name="floor" type="plane" size="0 0 1"/>'


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


ENTRIES = {
    "mass": Randomize("mass", bodies=("upper", "fore"), range=(0.7, 1.6)),
    "center": Randomize("center_of_mass", bodies="upper", range=(-0.05, 0.05), operation="add"),
    "inertia": Randomize("inertia", bodies=("upper", "finger"), range=(1.5, 3.0)),
    "stretch": Randomize("inertia", bodies="hand", range={"x": (3.0, 5.0)}, shared=True),
    "payload": Randomize("payload", bodies="fore", range=(0.3, 0.6), operation="add", at=(0.1, 0.05, 0.02)),
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
JOINTS = ("shoulder", "elbow", "wrist", "slide")


def arm_model(drawn: Callable[[str], float], without: str = "") -> mujoco.MjModel:
    """The arm as MuJoCo compiles it, edited by hand but for one entry; payload and stretched hand are geoms of its file."""

    def of(place: str, own: float = 1.0) -> float:
        return own if place.partition("/")[0] == without else drawn(place)

    model = mujoco.MjModel.from_xml_string(ARM.format(load="", hand=0.04 * np.sqrt(of("stretch/x"))))
    # the mass is scaled before the payload is added
    load = f'<geom type="sphere" size="0.0001" pos="{PAYLOAD_AT}" mass="{of("payload/fore", 1e-9)}"/>'
    scaled = ARM.replace('mass="0.8"', f'mass="{0.8 * of("mass/fore")}"')
    fore, body = model.body("fore"), mujoco.MjModel.from_xml_string(scaled.format(load=load, hand=0.04)).body("fore")
    fore.mass, fore.ipos, fore.iquat, fore.inertia = body.mass, body.ipos, body.iquat, body.inertia
    upper = model.body("upper")
    upper.mass *= of("mass/upper")
    upper.inertia *= of("mass/upper") * of("inertia/upper")
    upper.ipos += [of(f"center/upper/{axis}", 0.0) for axis in "xyz"]
    model.body("finger").inertia *= of("inertia/finger")
    model.joint("shoulder").range += [0.0, of("limits/shoulder/upper", 0.0)]
    for index, name in enumerate(JOINTS):  # and dofs and actuators
        model.dof_armature[index] *= of(f"armature/{name}")
        model.dof_damping[index] *= of(f"joint_damping/{name}")
        model.dof_frictionloss[index] = of(f"joint_friction/{name}", model.dof_frictionloss[index])
        gain, bias = model.actuator_gainprm[index], model.actuator_biasprm[index]
        if name in ("shoulder", "slide"):
            gain[0] = of(f"stiffness/{name}", gain[0])
            bias[1] = -gain[0]
        if name in ("shoulder", "elbow"):
            bias[2] -= of(f"damping/{name}", 0.0)
        if name == "elbow":
            gain[0] = -bias[2]
        gain *= of(f"strength/{name}")
        bias *= of(f"strength/{name}")
    effort = of("effort/shoulder", 9.0)
    model.actuator_forcerange[0] = -effort, effort
    model.opt.gravity += [of("gravity/gravity/x", 0.0), 0.0, of("gravity/gravity/z", 0.0)]
    return model


def drawn_in(randomizations: Randomizations, world: int) -> dict[str, float]:
    return dict(zip(randomizations.names, randomizations.draws[world].tolist(), strict=True))


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
        drawn = drawn_in(randomizations, world).__getitem__
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
        drawn = drawn_in(randomizations, world).__getitem__
        model = arm_model(drawn)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        for name in ("body_subtreemass", "body_invweight0", "dof_invweight0"):
            got = getattr(worlds.solver.mjw_model, name).numpy()[world]
            np.testing.assert_allclose(got, getattr(model, name), rtol=2e-4, err_msg=name)


def thrown(worlds: Worlds, start: np.ndarray, velocity: np.ndarray, center: np.ndarray, steps: int) -> np.ndarray:
    """Where bodies get to, from a place and velocities as MuJoCo has them: Newton's are those of the centre of mass."""
    joint_q, linear = start[[0, 1, 2, 4, 5, 6, 3]], velocity[:, :3] + np.cross(velocity[:, 3:], center)
    worlds.arrays.joint_q.assign(np.tile(joint_q, (WORLDS, 1)).astype(np.float32))
    worlds.arrays.joint_qd.assign(np.hstack([linear, velocity[:, 3:]]).astype(np.float32))
    for _ in range(steps):
        worlds.simulate()
    return worlds.arrays.joint_q.numpy()[:, [0, 1, 2, 6, 3, 4, 5]]


FEET = ("left", "right", "rear")


@pytest.mark.parametrize("operation", ["scale", "set"])
def test_a_sled_slides_as_in_mujoco(operation: str) -> None:
    text = SLED.format(ground="", actuator='<actuator><motor joint="sled"/></actuator>')
    text = text.replace("<freejoint/>", '<freejoint name="sled"/>')
    worlds, view = build_worlds(text, ground=True, njmax=40, nconmax=8)
    own = worlds.solver.mjw_model.geom_friction.numpy()[0].copy()
    ends = (0.3, 0.9) if operation == "scale" else (0.2, 0.6)
    entries = {
        "ground": Randomize("friction", geoms="ground_plane", range=(0.01, 0.02), operation="set", robot=None),
        "feet": Randomize("friction", geoms=FEET, range={"slide": ends, "torsion": (0.5, 4.0)}, operation=operation),
        "gravity": Randomize("gravity", range=(0.5, 0.9)),
    }
    randomizations = randomize(entries, worlds, view)
    changed = worlds.solver.mjw_model.geom_friction.numpy()
    assert changed.shape[1] == len(own) and not np.allclose(changed[0], changed[1])
    velocity = np.array([[1.2, 0.4, 0, 0, 0, 1.5], [0.8, -0.7, 0, 0, 0, -2.0]])
    start, steps, moved = np.array([0, 0, 0.0199, 1, 0, 0, 0]), 60, []
    got = thrown(worlds, start, velocity, worlds.model.body_com.numpy()[:WORLDS], steps)
    for world in range(WORLDS):
        drawn = drawn_in(randomizations, world).__getitem__
        model = mujoco.MjModel.from_xml_string(SLED.format(ground=FLOOR, actuator=""))
        unchanged = run_reference(model, worlds, start, velocity[world], np.zeros(0), steps)
        model.geom("floor").friction = [drawn("ground/ground_plane/slide"), *own[-1][1:]]
        for foot in FEET:
            numbers = np.array([drawn(f"feet/{foot}/{axis}") for axis in ("slide", "torsion")])
            model.geom(foot).friction[:2] = numbers * (model.geom(foot).friction[:2] if operation == "scale" else 1)
        model.opt.gravity[2] *= drawn("gravity/gravity/z")
        expected = run_reference(model, worlds, start, velocity[world], np.zeros(0), steps)
        np.testing.assert_allclose(got[world], expected, atol=3e-4)
        moved.append(np.abs(unchanged - expected).max())
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
    start, velocity = np.array([0, 0, 1, 1, 0, 0, 0]), np.array([0.3, -0.2, 2.0, 3.0, -4.0, 5.0])
    got = thrown(worlds, start, np.tile(velocity, (WORLDS, 1)), center, 60)
    moments = {"x": 0.07**2 + 0.05**2, "y": 0.1**2 + 0.05**2, "z": 0.1**2 + 0.07**2}  # of a box of 2 kg, times 3 / 2
    diagonal = [2.0 / 3.0 * moment for moment in moments.values()]
    np.testing.assert_allclose(np.sort(own), np.sort(diagonal), rtol=1e-5)
    for world in range(WORLDS):
        at, inertia = (" ".join(map(str, values)) for values in (center[world], diagonal))
        inertial = f'<inertial pos="{at}" mass="2" diaginertia="{inertia}"/>'
        model = mujoco.MjModel.from_xml_string(CUBE.format(inertial=inertial, actuator=""))
        expected = run_reference(model, worlds, start, velocity, np.zeros(0), 60)
        np.testing.assert_allclose(got[world], expected, atol=1e-4)


def test_explicit_motors_have_the_drawn_gains_and_limits() -> None:
    motors = [ExplicitPDActuator("*", stiffness=12.0, damping=0.6, effort_limit=6.0)]
    text = ARM.format(load="", hand=0.04)
    worlds, view = build_worlds(Robot(text, actuators=motors), njmax=20, nconmax=0, disable_contacts=True)
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
        drawn = drawn_in(randomizations, world)
        kp = 12.0 * np.array([drawn[f"stiffness/{name}"] for name in JOINTS])
        kd = 0.6 + np.array([drawn[f"damping/{name}"] for name in JOINTS])
        limit, strength = np.array([drawn["limit/shoulder"], 6, 6, 6]), np.array([1, drawn["strength/elbow"], 1, 1])
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
