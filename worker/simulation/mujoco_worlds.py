"""MuJoCo-Warp's model and data of many equal worlds: those of one world, repeated on the device."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp

from worker.simulation.tiling import fill


class MujocoWorlds:
    """The module ``mujoco_warp``, whose ``put_model`` and ``put_data`` take a time and host memory that hardly depend on the number of worlds.

    They return, bit for bit, what the module's own do, except for arrays that those leave uninitialized. The module itself makes each array
    on the host, with a row for each world.

    Args:
        module: ``mujoco_warp``.
    """

    def __init__(self, module: ModuleType) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)

    def put_model(self, model: Any, batch_sizes: Mapping[str, int] | None = None) -> Any:
        """``mujoco_warp.put_model``, with as many rows of each field as ``batch_sizes`` says."""
        one = self._module.put_model(model)
        for name, count in (batch_sizes or {}).items():
            setattr(one, name, _of_worlds(getattr(one, name), count, (1,)))
        return one

    def put_data(self, model: Any, data: Any, nworld: int = 1, **limits: int | None) -> Any:
        """``mujoco_warp.put_data``; ``limits`` are those of one world."""
        found = self._module.put_data(model, data, nworld=1, **limits)
        if nworld > 1:
            _repeat(found, nworld, data.ncon)
            _repeat(found.efc, nworld, 0)
            _repeat(found.contact, nworld, data.ncon)
            worlds = np.zeros(found.naconmax, np.int32)
            worlds[: nworld * data.ncon] = np.repeat(np.arange(nworld), data.ncon)
            found.contact.worldid.assign(worlds)
            found.nacon.fill_(nworld * data.ncon)
        return found


def _repeat(one: Any, count: int, contacts: int) -> None:
    """Give each field of one world's data its rows of ``count`` worlds, in place; the contacts of all worlds come before the unused rows."""
    for field in dataclasses.fields(one):
        value, rows = getattr(one, field.name), getattr(field.type, "shape", ("",))[0]
        if rows == "nworld" and value.shape[0] == 1:
            setattr(one, field.name, _of_worlds(value, count, (1,)))
        elif rows == "naconmax" and value.shape[0]:
            setattr(one, field.name, _of_worlds(value, count, (contacts, value.shape[0])))
        elif field.name in ("nworld", "naconmax", "naccdmax"):
            setattr(one, field.name, count * value)


def _of_worlds(array: wp.array[Any], count: int, ends: tuple[int, ...]) -> Any:
    """Each part of an array, up to each of ``ends``, ``count`` times."""
    target: Any = wp.empty((count * ends[-1], *array.shape[1:]), dtype=array.dtype, device=array.device)
    for first, end in itertools.pairwise((0, *ends)):
        if first < end and array.size:
            fill(target[count * first : count * end], array[first:end])
    if hasattr(array, "_is_batched"):  # MuJoCo-Warp's mark
        target._is_batched = array._is_batched
    return target
