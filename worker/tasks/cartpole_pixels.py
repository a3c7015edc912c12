"""The cart-pole, seen through a camera alone."""

from __future__ import annotations

from worker.tasks.cartpole import Cartpole
from worker.tasks.configs.cartpole import CartpolePixelsConfig


class CartpolePixels(Cartpole):
    """Cart and pole through a camera: two images of 64 x 64 in colour, 1 action, 60 control steps a second, episodes of 5 s."""

    config_type = CartpolePixelsConfig
