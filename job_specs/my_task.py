"""A whole task of your own: a motor swings a pendulum up. `job_specs/my-task.yaml` trains it."""

import math

import warp as wp

from worker.tasks import Action, Declaration, Event, Observation, Reward, Robot, RobotArrays, Task, WorldArrays, terms

MODEL = """<mujoco><worldbody><body pos="0 0 1">
  <joint name="hinge" type="hinge" axis="0 1 0" damping="0.02"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03" mass="0.5" contype="0" conaffinity="0"/>
</body></worldbody><actuator><motor joint="hinge" gear="2"/></actuator></mujoco>"""


@wp.func
def pointing(world: int, worlds: WorldArrays, robot: RobotArrays, joint: int, target: float) -> float:
    return wp.cos(worlds.joint_q[world, robot.coordinates[joint]] - target)


class Pendulum(Task, config={"episode_seconds": 4.0}):
    """A pendulum that hangs down and a motor that must swing it up: 3 observations, 1 action."""

    solver_options = {"disable_contacts": True, "njmax": 1, "nconmax": 0}

    def robot(self, config):
        return Robot(MODEL)

    def declare(self, config):
        return Declaration(
            actions={"torque": Action(terms.effort)},
            observations={
                "cosine": Observation(pointing, names=["cosine"], target=0.0),
                "sine": Observation(pointing, names=["sine"], target=math.pi / 2.0),
                "velocity": Observation(terms.joint_velocity, names=["velocity"], scale=0.1, unit="rad/s"),
            },
            rewards={
                "upright": Reward(pointing, weight=1.0, target=math.pi),
                "speed": Reward(terms.joint_velocity_squared, weight=-0.01),
                "effort": Reward(terms.action_squared, weight=-0.01),
            },
            events={"place": Event(terms.reset_joints_by_offset, position=(-math.pi, math.pi))},
        )
