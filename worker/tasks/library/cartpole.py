"""Balance a pole on a cart that a motor pushes along a rail."""

from __future__ import annotations

from pathlib import Path

import warp as wp

from worker.settings.cartpole import CartpoleConfig
from worker.simulation.episodes import EpisodeArrays, clipped_action
from worker.simulation.robot import Robot
from worker.simulation.robot_arrays import RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks import terms
from worker.tasks.declare.declaration import Action, Declaration, Event, Observation, Reward, Termination
from worker.tasks.run.task import Task

wp.set_module_options({"enable_backward": False})


@wp.func
def place(
    world: int,
    worlds: WorldArrays,
    robot: RobotArrays,
    stream: wp.uint32,
    position: float,
    angle: float,
    velocity: float,
):
    """Put cart and pole at random near the middle of the rail and the vertical."""
    worlds.joint_q[world, robot.coordinates[0]] = position * wp.randf(stream, -1.0, 1.0)
    worlds.joint_q[world, robot.coordinates[1]] = angle * wp.randf(stream, -1.0, 1.0)
    worlds.joint_qd[world, robot.dofs[0]] = velocity * wp.randf(stream, -1.0, 1.0)
    worlds.joint_qd[world, robot.dofs[1]] = velocity * wp.randf(stream, -1.0, 1.0)


@wp.func
def effort(world: int, episodes: EpisodeArrays, action: int) -> float:
    """Square of the clipped action."""
    felt = clipped_action(episodes, world, action)
    return felt * felt


class Cartpole(Task):
    """Cart and pole: 4 observations, 1 action, 60 control steps a second, episodes of 5 s."""

    config_type = CartpoleConfig
    solver_options = {"disable_contacts": True, "njmax": 1, "nconmax": 0}

    def robot(self, config: CartpoleConfig) -> Robot:
        """Cart on a slide joint, pole on a free hinge, motor on the slide; nothing collides."""
        return Robot(Path(__file__).with_name("cartpole.xml"), passive=True)

    def declare(self, config: CartpoleConfig) -> Declaration:
        """The terms; the costs of cart and pole count in the step of a fall, too."""
        return Declaration(
            actions={"force": Action(terms.effort, joints="slider", unit="N")},
            observations={
                "position": Observation(terms.joint_position, unit=("m", "rad")),
                "velocity": Observation(terms.joint_velocity, unit=("m/s", "rad/s")),
            },
            rewards={
                "alive": Reward(terms.alive),
                "angle": Reward(terms.joint_deviation_squared, joints="hinge"),
                "position": Reward(terms.joint_deviation_squared, joints="slider"),
                "velocity": Reward(terms.joint_velocity_squared, joints="slider"),
                "effort": Reward(effort),
                "fall": Reward(terms.ended),
            },
            terminations={
                "left_rail": Termination(
                    terms.joint_out_of_range, joints="slider", bounds=(-config.cart_limit, config.cart_limit)
                ),
                "dropped_pole": Termination(
                    terms.joint_out_of_range, joints="hinge", bounds=(-config.angle_limit, config.angle_limit)
                ),
            },
            events={
                "place": Event(
                    place, position=config.start_position, angle=config.start_angle, velocity=config.start_velocity
                )
            },
        )
