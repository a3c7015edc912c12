"""The cart-pole from pixels: seen through a camera alone."""

from __future__ import annotations

from worker.settings.cartpole import CartpolePixelsConfig
from worker.tasks.library.cartpole import Cartpole


class CartpolePixels(Cartpole):
    """Cart and pole through a camera: two images of 64 x 64 in colour, 1 action, 60 control steps a second, episodes of 5 s."""

    config_type = CartpolePixelsConfig
