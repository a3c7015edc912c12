"""A model of many equal worlds, made of Newton's own models of two and three of them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import newton
import numpy as np
import warp as wp

BY_NEWTON = 32
"""Up to this many worlds Newton itself is as quick."""
FEW = 3
"""Number of worlds of the larger one of the two models in which rules are found."""
_NOT_COMPARED = ("bvh_", "_bvh_", "heightfield_", "attribute_", "soft_mesh_adjacency", "_deformable_visual")
"""Prefixes of what is built anew for all worlds, is the terrain's, says nothing of worlds, or is empty in a model without particles."""
_NAMES = ("_deprecated_aliases", "_removed_attributes")
"""Members of a namespace that are about names."""


class Irregular(Exception):
    """An attribute does not grow by equal blocks, one for each world."""


def tiled(scene: Callable[[int], newton.ModelBuilder], count: int, device: str) -> newton.Model:
    """The model of ``scene(count)``, bit for bit that of ``finalize``, in a time that hardly depends on ``count``.

    Each attribute of a model with equal worlds consists of one block for each world, and behind them what all worlds share. Integers may
    also grow linearly with the world and with the number of worlds. The rule of each is found and checked in models of two and three worlds.

    Args:
        scene: Returns a builder with a number of equal worlds, and behind them what they share.
        count: Number of worlds.
        device: ``"cpu"`` or ``"cuda:<n>"``.

    Returns:
        The model. Where an attribute follows no rule, Newton itself built it, after a warning that names the attribute.
    """
    if count <= max(FEW, BY_NEWTON):
        return scene(count).finalize(device=device)
    two, builder = _with_few_heights(scene(FEW - 1)).finalize(device=device), scene(FEW)
    model = builder.finalize(device=device)
    try:
        _Growth(count).apply(two, model)
    except Irregular as error:
        warnings.warn(f"the worlds are built one by one, which takes long: model.{error}", stacklevel=3)
        return scene(count).finalize(device=device)
    config = builder.default_bvh_cfg
    state: Any = model  # as finalize has it: the poses of the model itself
    model.bvh_build_shapes(state, bvh_constructor=config.shape_constructor, shape_flags=config.shape_flags)
    return model


def _with_few_heights(builder: newton.ModelBuilder) -> newton.ModelBuilder:
    """Put a field of four heights in place of each of a terrain's, whose mesh takes longer than all else."""
    for shape, source in enumerate(builder.shape_source):
        if isinstance(source, newton.Heightfield) and builder.shape_world[shape] == -1:
            ends = {"min_z": source.min_z, "max_z": source.max_z}
            builder.shape_source[shape] = newton.Heightfield([[0, 1], [0, 1]], 2, 2, source.hx, source.hy, **ends)
    return builder


def fill(target: wp.array[Any], rows: wp.array[Any]) -> None:
    """Fill an array with copies of rows, one behind the other, on their device. Both are contiguous; the rows fit a whole number of times."""
    size = rows.size * wp.types.type_size_in_bytes(rows.dtype)
    word = wp.uint32 if size % 4 == 0 else wp.uint8
    step = wp.types.type_size_in_bytes(word)
    shape = target.shape[0] // rows.shape[0], size // step

    def words(array: wp.array[Any], stride: int) -> wp.array[Any]:
        return wp.array(ptr=array.ptr, dtype=word, shape=shape, strides=(stride, step), device=array.device)

    wp.copy(words(target, size), words(rows, 0))  # each copy begins where the first one does


class _Rule:
    """How rows become those of more worlds.

    Attributes:
        block: Number of rows of each world.
        rest: Number of rows that all worlds share.
        is_plain: Whether all worlds have the same rows, and the others do not depend on the number of worlds.
    """

    def __init__(self, where: str, two: Any, three: Any) -> None:
        self.block = block = len(three) - len(two)
        self.rest = len(three) - FEW * block
        if block < 0 or self.rest < 0 or two.shape[1:] != three.shape[1:] or two.dtype != three.dtype:
            raise Irregular(f"{where} has the shape {two.shape} in two worlds and {three.shape} in three")
        self._three, self._changes = three, None
        worlds = three[: FEW * block].reshape(FEW, block, *three.shape[1:])
        fewer = two[: 2 * block].reshape(2, block, *three.shape[1:])
        rests = three[FEW * block :], two[2 * block :]
        if three.dtype.kind in "iu" and three.dtype != np.uint64:
            step, *others = worlds[1] - worlds[0], worlds[2] - worlds[1], fewer[1] - fewer[0]
            is_regular = all(np.array_equal(step, other) for other in others)
            changes = step, worlds[0] - fewer[0], rests[0] - rests[1]
            if any(change.any() for change in changes):
                self._changes = changes
        else:
            is_address = three.dtype == np.uint64  # each model has its own
            same = [each.tobytes() for each in (*worlds, *(() if is_address else fewer))]
            is_regular = len({*same}) == 1 and (is_address or rests[0].tobytes() == rests[1].tobytes())
        if not is_regular:
            raise Irregular(f"{where} differs between the worlds")
        self.is_plain = self._changes is None

    def rows(self, count: int) -> Any:
        """The rows of ``count`` worlds."""
        block, three = self.block, self._three
        rows = np.empty((count * block + self.rest, *three.shape[1:]), three.dtype)
        worlds = rows[: count * block].reshape(count, block, *three.shape[1:])
        worlds[:], rows[count * block :] = three[:block], three[FEW * block :]
        if self._changes is not None:
            with_world, with_count, of_rest = self._changes
            worlds += with_world * np.arange(count, dtype=three.dtype).reshape(count, *(1,) * three.ndim)
            worlds += (count - FEW) * with_count
            rows[count * block :] += (count - FEW) * of_rest
        return rows


class _BodyShapes(Mapping[int, list[int]]):
    """The shapes of each body, and of none (-1), as ``newton.Model.body_shapes`` has them; a list of each body would take seconds."""

    def __init__(self, of_world: Mapping[int, list[int]], count: int, shapes: int, of_none: list[int]) -> None:
        self._of_world, self._shapes, self._of_none = of_world, shapes, of_none
        self._bodies = len(of_world)
        self._count = count

    def __getitem__(self, body: int) -> list[int]:
        if body == -1:
            return self._of_none
        world, local = divmod(body, self._bodies) if self._bodies else (self._count, 0)
        if not 0 <= world < self._count:
            raise KeyError(body)
        return [shape + world * self._shapes for shape in self._of_world[local]]

    def __iter__(self) -> Iterator[int]:
        return iter(range(-1, self._count * self._bodies))

    def __len__(self) -> int:
        return 1 + self._count * self._bodies


class _Growth:
    """Makes the model of three worlds that of ``count``; in place, since closures of Newton's hold it."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._made: dict[int, tuple[Any, Any]] = {}  # an array that two attributes share stays one

    def apply(self, two: newton.Model, three: newton.Model) -> None:
        if three.particle_count or three.actuators:
            raise Irregular("particle_count or model.actuators: only rigid bodies are tiled")
        if three.heightfield_count != two.heightfield_count:
            raise Irregular("heightfield_count: each world has height fields of its own")
        for owner, name, value in [*self._members("", two, three, _NOT_COMPARED)]:
            vars(owner)[name] = value

    def _members(self, where: str, two: Any, three: Any, left_out: tuple[str, ...]) -> Iterator[tuple[Any, str, Any]]:
        if vars(two).keys() != vars(three).keys():
            raise Irregular(f"{where} has other members in two worlds than in three")
        for name, value in vars(three).items():
            if name.startswith(left_out):
                continue
            path, other = f"{where}{name}", vars(two)[name]
            if type(value).__module__.startswith("newton.") and hasattr(value, "__dict__") and value != other:
                yield from self._members(f"{path}.", other, value, _NAMES)
            else:
                yield three, name, self._grown(path, other, value)

    def _grown(self, where: str, two: Any, three: Any) -> Any:
        if type(two) is not type(three):
            raise Irregular(f"{where} is a {type(two).__name__} in two worlds and a {type(three).__name__} in three")
        if isinstance(three, wp.array | np.ndarray):
            if id(three) not in self._made:
                make: Any = self._array if isinstance(three, wp.array) else self._rows
                self._made[id(three)] = three, make(where, two, three)
            return self._made[id(three)][1]
        if isinstance(three, list):
            return self._list(where, two, three)
        if where == "body_shapes":
            return self._body_shapes(where, two, three)
        if isinstance(three, dict) and two.keys() == three.keys():
            return {key: self._grown(f"{where}[{key!r}]", two[key], three[key]) for key in three}
        if type(three) is int and "count" in where:
            return three + (self._count - FEW) * (three - two)
        if isinstance(three, wp.Mesh) or _is_equal(two, three):
            return three
        raise Irregular(f"{where} is {two!r} in two worlds and {three!r} in three")

    def _rows(self, where: str, two: Any, three: Any) -> Any:
        try:
            rows = _Rule(where, two, three).rows(self._count)
        except Irregular:  # unless what the worlds share comes first
            rows = _Rule(where, two[::-1], three[::-1]).rows(self._count)[::-1].copy()
        rows.setflags(write=three.flags.writeable)
        return rows

    def _array(self, where: str, two: wp.array[Any], three: wp.array[Any]) -> wp.array[Any]:
        rule = _Rule(where, two.numpy(), three.numpy())
        if not rule.is_plain:
            return wp.array(rule.rows(self._count), dtype=three.dtype, device=three.device)
        if not rule.block:
            return three
        end = self._count * rule.block
        target: wp.array[Any] = wp.empty((end + rule.rest, *three.shape[1:]), dtype=three.dtype, device=three.device)
        fill(target[:end], three[: rule.block])
        if rule.rest:
            wp.copy(target[end:], three[FEW * rule.block :])
        return target

    def _list(self, where: str, two: list[Any], three: list[Any]) -> list[Any]:
        block = len(three) - len(two)
        if not block:
            return [self._grown(f"{where}[{index}]", two[index], three[index]) for index in range(len(three))]
        first = three[:block]
        if block < 0 or three[: FEW * block] != FEW * first or two[: 2 * block] != 2 * first:
            raise Irregular(f"{where} differs between the worlds")
        return first * self._count + three[FEW * block :]

    def _body_shapes(self, where: str, two: dict[int, list[int]], three: dict[int, list[int]]) -> _BodyShapes:
        bodies = len(three) - len(two)
        of_world = {body: three[body] for body in range(bodies)}
        shapes = next((three[bodies + body][0] - found[0] for body, found in of_world.items() if found), 0)
        if dict(_BodyShapes(of_world, FEW, shapes, three[-1])) != three:
            raise Irregular(f"{where} differs between the worlds")
        of_none = self._rows(f"{where}[-1]", *(np.array(each[-1], np.int64) for each in (two, three))).tolist()
        return _BodyShapes(of_world, self._count, shapes, of_none)


def _is_equal(one: Any, other: Any) -> bool:
    try:
        return bool(one == other)
    except (TypeError, ValueError):  # of arrays in it
        return False
