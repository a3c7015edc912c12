"""Robots that follow velocity commands, and MuJoCo's own engine that does the same beside each of their worlds."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import numpy as np

from tests.support.worker.robots import need_mjlab, reference
from worker.tasks import find_task
from worker.tasks.library.velocity import Velocity

SUBSTEPS, PHYSICS, CONTROL = 4, 0.005, 0.02
"""Physics steps of a control step, and the lengths of both [s]."""
QUIET = ("base_lin_vel", "base_ang_vel", "projected_gravity", "joint_pos", "joint_vel")
"""Observations with noise."""


def plain(name: str, worlds: int, *, numbers: dict[str, Any] | None = None, **config: Any) -> Velocity:
    """A task without noise, pushes and differences between worlds, with an exact solver and all weights 1."""
    need_mjlab()
    kind: Any = find_task(name)
    # of the same name: its kernels are those of the task
    alike: type[Velocity] = type(name, (kind,), {"walker": dataclasses.replace(kind.walker, randomize={})})
    noisy = (*QUIET, "height_scan") if kind.rough else QUIET
    settings = kind.config_type(
        numbers={**{f"observations.{each}.noise": 0.0 for each in noisy}, **(numbers or {})},
        rewards=dict.fromkeys(kind.config_type().rewards, 1.0),
        push_seconds=(1000.0, 1000.0),
        solver_iterations=100,
        solver_line_search=50,
        **config,
    )
    task: Velocity = alike(settings, worlds, seed=1)
    return task


class Twin:
    """MuJoCo's own engine beside one world of a task on a plane.

    Args:
        task: Of which it has the robot, from the same file.
        feet: Names of the feet's geoms, foot by foot.
    """

    def __init__(self, task: Velocity, feet: list[list[str]]) -> None:
        self.task, self.view = task, task.views["robot"]
        robot = task.walker.robot()
        self.model = reference(robot)
        options, supplied = self.model.opt, task.solver_options
        options.cone = getattr(mujoco.mjtCone, f"mjCONE_{supplied['cone'].upper()}")
        options.impratio, options.iterations, options.tolerance = supplied["impratio"], 200, 1e-12
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(name) for name in self.view.joint_names]
        self.places = [int(joint.qposadr[0]) for joint in joints]
        self.rates = [int(joint.dofadr[0]) for joint in joints]
        self.inputs = [int(self.model.actuator(name).id) for name in self.view.joint_names]
        self.feet = [[int(self.model.geom(name).id) for name in names] for names in feet]
        self.air = np.zeros(len(feet))
        self.touch = np.zeros(len(feet))
        self.peak = np.zeros(len(feet))
        self.hits = 0
        self.found = np.zeros(len(feet), int)
        self.forces = np.zeros((len(feet), 3))

    def forget(self) -> None:
        """A new episode."""
        self.air[:] = self.touch[:] = self.peak[:] = 0.0

    def take(self, joint_q: np.ndarray, joint_qd: np.ndarray) -> None:
        """Be where a world is. Newton's free root has the velocity of its centre of mass and turns about the world's axes."""
        position, x, y, z, w = joint_q[:3], *joint_q[3:7]
        self.data.qpos[:7] = [*position, w, x, y, z]
        self.data.qpos[self.places] = joint_q[self.view.coordinates]
        flat = np.zeros(9)
        mujoco.mju_quat2Mat(flat, self.data.qpos[3:7])
        turn = flat.reshape(3, 3)
        self.data.qvel[:3] = joint_qd[:3] - np.cross(joint_qd[3:6], turn @ self.model.body_ipos[1])
        self.data.qvel[3:6] = turn.T @ joint_qd[3:6]
        self.data.qvel[self.rates] = joint_qd[self.view.dofs]

    def step(self, targets: np.ndarray) -> None:
        """One control step; contacts are summed up as they come."""
        self.data.ctrl[self.inputs] = targets
        self.hits = 0
        for _ in range(SUBSTEPS):
            mujoco.mj_step(self.model, self.data)
            self._touch()
        mujoco.mj_forward(self.model, self.data)

    def _touch(self) -> None:
        self.found[:], self.forces[:] = 0, 0.0
        strongest = 0.0
        for index in range(self.data.ncon):
            contact, force = self.data.contact[index], np.zeros(6)
            if contact.efc_address < 0:
                continue
            mujoco.mj_contactForce(self.model, self.data, index, force)
            bodies = self.model.geom_bodyid[contact.geom]
            if bodies.min() > 0:
                strongest = max(strongest, float(np.linalg.norm(force[:3])))
                continue
            on_second = contact.frame.reshape(3, 3).T @ force[:3]
            for foot, geoms in enumerate(self.feet):
                for geom, sign in zip(contact.geom, (-1.0, 1.0), strict=True):
                    if geom in geoms:
                        self.found[foot] += 1
                        self.forces[foot] += sign * on_second
        self.hits += strongest > 10.0
        self.air = np.where(self.found > 0, 0.0, self.air + PHYSICS)
        self.touch = np.where(self.found > 0, self.touch + PHYSICS, 0.0)

    def landed(self) -> np.ndarray:
        """Of each foot, whether it came down in this control step and stays."""
        return (self.touch > 0) & (self.touch < CONTROL + 1e-6)

    def turn(self, body: str) -> np.ndarray:
        """Rotation matrix of a body."""
        turn: np.ndarray = self.data.body(body).xmat.reshape(3, 3).copy()
        return turn

    def velocity(self, kind: Any, name: str, local: bool) -> tuple[np.ndarray, np.ndarray]:
        """Linear and angular velocity of the origin of a body or site."""
        found = np.zeros(6)
        item = mujoco.mj_name2id(self.model, kind, name)
        mujoco.mj_objectVelocity(self.model, self.data, kind, item, found, int(local))
        return found[3:], found[:3]

    def soles(self) -> tuple[np.ndarray, np.ndarray]:
        """Height [m] and horizontal speed [m/s] of each sole."""
        names = self.task.walker.soles
        heights = np.array([self.data.site(name).xpos[2] for name in names])
        moved = [self.velocity(mujoco.mjtObj.mjOBJ_SITE, name, False)[0] for name in names]
        return np.clip(heights, 0.0, 1.0), np.linalg.norm(np.array(moved)[:, :2], axis=1)
