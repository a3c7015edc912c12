"""MuJoCo-Warp's broad phase as one kernel for all numbers of worlds: its code holds that number, and would be compiled for each anew."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mujoco_warp._src import collision_driver

_MANY = 2**30
"""More worlds than there are."""


@contextmanager
def for_any_number(worlds: int) -> Iterator[None]:
    """A block whose broad phase, of ``worlds`` worlds, is launched by a kernel that is right for every other number, too.

    The kernel finds a world's row as ``world % rows``, with the numbers of rows of seven arrays in its code. An array has one row, or one
    for each world, and then every greater number gives the same row.
    """
    made = collision_driver._nxn_broadphase

    def kernel(kinds: int, *rows: Any) -> Any:
        return made(kinds, *(_MANY if count == worlds > 1 else count for count in rows[:7]), *rows[7:])

    collision_driver._nxn_broadphase = kernel
    try:
        yield
    finally:
        collision_driver._nxn_broadphase = made
