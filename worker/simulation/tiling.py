"""The tiling of equal worlds: a model of many, made of Newton's own models of one, two and three of them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import newton
import numpy as np
import warp as wp

BY_NEWTON = 32
"""Up to this many worlds Newton itself is as quick."""
FEW = 3
"""Number of worlds of the largest one of the models in which rules are found; the others have one less and two less."""
_NOT_COMPARED = ("bvh_", "_bvh_", "heightfield_", "attribute_", "soft_mesh_adjacency", "_deformable_visual")
"""Prefixes of what is built anew for all worlds, is the terrain's, says nothing of worlds, or is empty in a model without particles."""
_NAMES = ("_deprecated_aliases", "_removed_attributes")
"""Members of a namespace that are about names."""


class Irregular(Exception):
    """An attribute does not grow by equal blocks, one for each world."""


def tiled(scene: Callable[[int], newton.ModelBuilder], count: int, device: str) -> newton.Model:
    """The model of ``scene(count)``, bit for bit that of ``finalize``, in a time that hardly depends on ``count``.

    Each attribute of a model with equal worlds consists of one block for each world, and behind them what all worlds share. Integers may
    also grow linearly with the world and with the number of worlds. The rule of each is found in models of two and three worlds and
    checked in one of one world.

    Args:
        scene: Returns a builder with a number of equal worlds, and behind them what they share.
        count: Number of worlds.
        device: ``"cpu"`` or ``"cuda:<n>"``.

    Returns:
        The model. Where an attribute follows no rule, Newton itself built it, after a warning that names the attribute.
    """
    if count <= max(FEW, BY_NEWTON):
        return scene(count).finalize(device=device)
    fewer = [_with_few_heights(scene(worlds)).finalize(device=device) for worlds in range(1, FEW)]
    builder = scene(FEW)
    model = builder.finalize(device=device)
    try:
        _Growth(count).apply(*fewer, model)
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

    def __init__(self, where: str, *found: Any) -> None:
        three = self._three = found[-1]
        self.block = block = len(three) - len(found[-2])
        self.rest = len(three) - FEW * block
        lengths = [worlds * block + self.rest for worlds in range(1, FEW + 1)]
        kinds = {(each.dtype, each.shape[1:]) for each in found}
        if block < 0 or self.rest < 0 or [*map(len, found)] != lengths or len(kinds) > 1:
            raise Irregular(f"{where} has the shapes {[each.shape for each in found]} in one, two and three worlds")
        worlds = [each[: count * block].reshape(count, block, *each.shape[1:]) for count, each in enumerate(found, 1)]
        rests = [each[len(each) - self.rest :] for each in found]
        self._changes = None
        if three.dtype.kind in "iu" and three.dtype != np.uint64:
            with_world = [each[world + 1] - each[world] for each in worlds for world in range(len(each) - 1)]
            with_count = [worlds[index + 1][0] - worlds[index][0] for index in range(FEW - 1)]
            of_rest = [rests[index + 1] - rests[index] for index in range(FEW - 1)]
            changes = with_world, with_count, of_rest
            is_regular = all(np.array_equal(each, change[0]) for change in changes for each in change)
            if any(change[0].any() for change in changes):
                self._changes = with_world[0], with_count[0], of_rest[0]
        else:
            compared = slice(-1, None) if three.dtype == np.uint64 else slice(None)  # each model has its own addresses
            same = {world.tobytes() for each in worlds[compared] for world in each}
            is_regular = len(same) == 1 and len({each.tobytes() for each in rests[compared]}) == 1
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

    def apply(self, *models: newton.Model) -> None:
        if models[-1].particle_count or models[-1].actuators:
            raise Irregular("particle_count or model.actuators: only rigid bodies are tiled")
        if len({model.heightfield_count for model in models}) > 1:
            raise Irregular("heightfield_count: each world has height fields of its own")
        for owner, name, value in [*self._members("", models, _NOT_COMPARED)]:
            vars(owner)[name] = value

    def _members(self, where: str, owners: Sequence[Any], left_out: tuple[str, ...]) -> Iterator[tuple[Any, str, Any]]:
        if any(vars(owner).keys() != vars(owners[0]).keys() for owner in owners):
            raise Irregular(f"{where} has other members in one world than in more")
        for name in vars(owners[0]):
            if name.startswith(left_out):
                continue
            path, found = f"{where}{name}", [vars(owner)[name] for owner in owners]
            value = found[-1]
            if type(value).__module__.startswith("newton.") and hasattr(value, "__dict__") and value != found[0]:
                yield from self._members(f"{path}.", found, _NAMES)
            else:
                yield owners[-1], name, self._grown(path, *found)

    def _grown(self, where: str, *found: Any) -> Any:
        value = found[-1]
        if len({type(each) for each in found}) > 1:
            raise Irregular(f"{where} has other types in one world than in more")
        if isinstance(value, wp.array | np.ndarray):
            if id(value) not in self._made:
                make: Any = self._array if isinstance(value, wp.array) else self._rows
                self._made[id(value)] = value, make(where, *found)
            return self._made[id(value)][1]
        if isinstance(value, list):
            return self._list(where, *found)
        if where == "body_shapes":
            return self._body_shapes(where, *found)
        if isinstance(value, dict) and all(each.keys() == value.keys() for each in found):
            return {key: self._grown(f"{where}[{key!r}]", *(each[key] for each in found)) for key in value}
        if type(value) is int and "count" in where:
            return int(self._rows(where, *(np.array([each], np.int64) for each in found))[0])
        if isinstance(value, wp.Mesh) or all(_is_equal(each, value) for each in found):
            return value
        raise Irregular(f"{where} has the values {found} in one, two and three worlds")

    def _rows(self, where: str, *found: Any) -> Any:
        try:
            rows = _Rule(where, *found).rows(self._count)
        except Irregular:  # unless what the worlds share comes first
            rows = _Rule(where, *(each[::-1] for each in found)).rows(self._count)[::-1].copy()
        rows.setflags(write=found[-1].flags.writeable)
        return rows

    def _array(self, where: str, *found: wp.array[Any]) -> wp.array[Any]:
        rule, array = _Rule(where, *(each.numpy() for each in found)), found[-1]
        if not rule.is_plain:
            return wp.array(rule.rows(self._count), dtype=array.dtype, device=array.device)
        if not rule.block:
            return array
        end = self._count * rule.block
        target: wp.array[Any] = wp.empty((end + rule.rest, *array.shape[1:]), dtype=array.dtype, device=array.device)
        fill(target[:end], array[: rule.block])
        if rule.rest:
            wp.copy(target[end:], array[FEW * rule.block :])
        return target

    def _list(self, where: str, *found: list[Any]) -> list[Any]:
        block = len(found[-1]) - len(found[-2])
        if all(len(each) == len(found[-1]) for each in found):
            return [self._grown(f"{where}[{index}]", *each) for index, each in enumerate(zip(*found, strict=True))]
        first = found[-1][:block]
        if block <= 0 or any(each[: worlds * block] != worlds * first for worlds, each in enumerate(found, 1)):
            raise Irregular(f"{where} differs between the worlds")
        return first * self._count + found[-1][FEW * block :]

    def _body_shapes(self, where: str, *found: dict[int, list[int]]) -> _BodyShapes:
        three, bodies = found[-1], len(found[-1]) - len(found[-2])
        of_world = {body: three[body] for body in range(bodies)}
        shapes = next((three[bodies + body][0] - own[0] for body, own in of_world.items() if own), 0)
        if dict(_BodyShapes(of_world, FEW, shapes, three[-1])) != three:
            raise Irregular(f"{where} differs between the worlds")
        of_none = self._rows(f"{where}[-1]", *(np.array(each[-1], np.int64) for each in found)).tolist()
        return _BodyShapes(of_world, self._count, shapes, of_none)


def _is_equal(one: Any, other: Any) -> bool:
    try:
        return bool(one == other)
    except (TypeError, ValueError):  # of arrays in it
        return False
