"""The cart-pole, seen through a camera alone."""

from __future__ import annotations

from dataclasses import dataclass, field

from worker.learning.ppo.settings import PPOConfig
from worker.simulation.camera import CameraConfig
from worker.tasks.cartpole import Cartpole, CartpoleConfig
from worker.tasks.config import nested


@dataclass(frozen=True)
class CartpolePixelsConfig(CartpoleConfig):
    """As :class:`worker.tasks.cartpole.CartpoleConfig`, on the part of the rail that the camera sees."""

    cart_limit: float = 1.4
    """Distance of the cart from the middle of the rail at which the episode ends [m]: there it leaves the image."""
    start_position: float = 0.3
    """A start is uniform in +- this distance from the middle [m]."""
    camera: CameraConfig = field(
        default_factory=lambda: CameraConfig(position=(0.0, -3.2, 1.4), target=(0.0, 0.0, 1.4), fov=0.93)
    )
    """The camera: it stands beside the rail and sees 3.2 m of it."""
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            steps=16,
            hidden_sizes=(64,),
            channels=(16, 32, 32),
            epochs=4,
            minibatches=4,
            learning_rate=1.0e-3,
            desired_kl=0.01,
            normalize_observations=False,
        )
    )
    """How the task is trained."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "camera", nested("camera", CameraConfig, self.camera))


class CartpolePixels(Cartpole):
    """Cart and pole through a camera: two images of 64 x 64 in colour, 1 action, 60 control steps a second, episodes of 5 s."""

    config_type = CartpolePixelsConfig
