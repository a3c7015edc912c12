"""MuJoCo's own model of the lift task, made from the arm's file as mjlab makes it, without Newton."""

from __future__ import annotations

import math
import re

import mujoco
import numpy as np

from worker.simulation.robot_files import read

GAINS = {  # effective inertia, frequency [Hz], armature, greatest force
    "joint1": (0.123153, 2.0, 0.032, 28.0),
    "joint2": (0.277411, 2.0, 0.032, 28.0),
    "joint3": (0.232763, 2.0, 0.032, 28.0),
    "joint4": (0.030154, 2.0, 0.0018, 10.0),
    "joint5": (0.009126, 2.0, 0.0018, 10.0),
    "joint6": (0.002868, 2.0, 0.0018, 10.0),
    "left_finger": (2.781624, 1.0, 0.0018 * (2.7 / 0.071) ** 2, 0.1 * 10.0 * 2.7 / 0.071),
}
HOME = np.array([0.0, 1.047, 1.05, -0.9, 0.0, 0.0, 0.01875, -0.01875])
"""Default positions of all joints, in the file's order."""
TIPS = r"[lr]f_down(6|7|8|9|10|11)_collision"


def stiffness(joint: str) -> float:
    inertia, frequency, _, _ = GAINS[joint]
    return inertia * (2.0 * math.pi * frequency) ** 2


def reference() -> mujoco.MjModel:
    """The arm 1 cm above the ground, a cube of 4 cm and 50 g, and the ground; joints of the arm, then the cube's."""
    spec = mujoco.MjSpec.from_file(read("package:mjlab/asset_zoo/robots/i2rt_yam/xmls/yam.xml").source)
    spec.body("arm").pos = [0.0, 0.0, 0.01]
    for geom in spec.geoms:
        _collide(geom)
    for name, (inertia, frequency, armature, effort) in GAINS.items():
        spec.joint(name).armature = armature
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        kp, kd = stiffness(name), 4.0 * inertia * 2.0 * math.pi * frequency
        actuator.gaintype, actuator.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        actuator.gainprm[0] = kp
        actuator.biasprm[:3] = [0.0, -kp, -kd]
        actuator.forcelimited, actuator.forcerange = True, [-effort, effort]
    cube = spec.worldbody.add_body(name="cube", pos=[0.3, 0.0, 0.04])
    cube.add_freejoint(name="cube")
    cube.add_geom(name="cube", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02] * 3, mass=0.05)
    spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.01])
    option = spec.option
    option.timestep, option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone, option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
    option.iterations, option.ls_iterations = 10, 20
    return spec.compile()


def _collide(geom: mujoco.MjsGeom) -> None:
    """As ``GRIPPER_ONLY_COLLISION`` of mjlab's ``yam_constants.py``."""
    geom.contype = geom.conaffinity = int(bool(re.fullmatch(r"(link6|[lr]f)_.*_collision", geom.name)))
    if not geom.contype:
        return
    geom.condim, geom.friction[0] = 3, 0.6
    if re.fullmatch(TIPS, geom.name):
        geom.condim, geom.priority = 6, 1
        geom.friction, geom.solref = [1.0, 5e-3, 5e-4], [0.01, 1.0]


def touching_pairs(model: mujoco.MjModel, names: list[str]) -> set[frozenset[str]]:
    """Pairs of geoms that MuJoCo lets collide: what masks, welds, parents and excluded pairs leave of bodies that move."""
    excluded = {int(signature) for signature in model.exclude_signature}
    pairs = set()
    for first in range(model.ngeom):
        for second in range(first + 1, model.ngeom):
            masks = model.geom_contype[first] & model.geom_conaffinity[second]
            masks |= model.geom_contype[second] & model.geom_conaffinity[first]
            bodies = sorted((int(model.geom_bodyid[first]), int(model.geom_bodyid[second])))
            welds = [int(model.body_weldid[body]) for body in bodies]
            parents = [int(model.body_weldid[model.body_parentid[weld]]) for weld in welds]
            related = 0 not in welds and (welds[0] == parents[1] or welds[1] == parents[0])
            apart = welds[0] == welds[1] or related or (bodies[0] << 16) + bodies[1] in excluded
            if masks and not apart and any(model.body_dofnum[welds]):
                pairs.add(frozenset((names[first], names[second])))
    return pairs


def to_mujoco(joint_q: np.ndarray) -> np.ndarray:
    """Newton's coordinates of a world: the cube's quaternion is xyzw there, wxyz in MuJoCo."""
    return np.concatenate([joint_q[:11], joint_q[14:15], joint_q[11:14]])
