"""Collision masks and contact parameters of MuJoCo, by geom-name pattern.

Two geoms of different bodies collide if ``contype`` of one and ``conaffinity`` of the other share a bit. The masks of all
robots, objects and the ground of a world mean the same; the ground's are 1 and 1.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import newton
import warp as wp

from worker.simulation.patterns import find, resolve

UNSET = -(2**63)
"""Newton's value for a shape without a mask."""
FIRST_OWN_BIT = 8
"""Each robot without self-collisions takes its own bit, from this one upwards."""
SOLREF_AS_WRITTEN = 1
"""Newton's mode of a geom whose ``solref`` is passed to MuJoCo unchanged."""
SOLIMP_DEFAULT = (0.9, 0.95, 0.001, 0.5, 2.0)
"""MuJoCo's default ``solimp``, which fills in numbers that are not given."""

Friction = float | tuple[float, ...]


@dataclass(frozen=True)
class Collision:
    """Collision settings of some geoms of a robot. They override the robot's file.

    Each argument except the patterns is one value for all matching geoms, or values by geom pattern; the first matching pattern wins.

    Args:
        geoms: Geom-name patterns.
        contype: MuJoCo's ``contype`` bits of the geom.
        conaffinity: ``contype`` bits of the geoms that it collides with.
        condim: Directions in which a contact has a force: 1, 3 (sliding friction), 4 (torsional too) or 6 (rolling too).
        priority: The contact takes its parameters from the geom of the higher priority.
        friction: Sliding, torsional [m] and rolling [m] coefficients, or the first of them; None: as in the file.
        solref: Time constant [s] and damping ratio of contacts; None: as in the file.
        solimp: Impedance of contacts, up to five numbers; those left out are MuJoCo's own; None: as in the file.
        only: Whether collisions are disabled for all other geoms of the robot.
    """

    geoms: str | Sequence[str]
    contype: int | Mapping[str, int] = 1
    conaffinity: int | Mapping[str, int] = 1
    condim: int | Mapping[str, int] = 3
    priority: int | Mapping[str, int] = 0
    friction: Friction | Mapping[str, Friction] | None = None
    solref: tuple[float, float] | Mapping[str, tuple[float, float]] | None = None
    solimp: tuple[float, ...] | Mapping[str, tuple[float, ...]] | None = None
    only: bool = True

    def __post_init__(self) -> None:
        for condim in self.condim.values() if isinstance(self.condim, Mapping) else (self.condim,):
            if condim not in (1, 3, 4, 6):
                raise ValueError(f"Collision({self.geoms!r}): condim is 1, 3, 4 or 6, not {condim!r}")
        for name in ("contype", "conaffinity"):
            value = getattr(self, name)
            for mask in value.values() if isinstance(value, Mapping) else (value,):
                if isinstance(mask, bool) or not isinstance(mask, int) or not 0 <= mask < 2**31:
                    raise ValueError(
                        f"Collision({self.geoms!r}): {name} is a whole number from 0 to 2^31 - 1, not {mask!r}"
                    )


def apply(
    builder: newton.ModelBuilder,
    names: Sequence[str],
    shapes: Sequence[int],
    collisions: Iterable[Collision],
    robot: str,
) -> None:
    """Apply masks and contact parameters to a builder of one robot, whose geoms are ``shapes`` of these names; later ones override earlier ones.

    Raises:
        ValueError: A pattern matches no geom, or the masks of a geom are given by patterns none of which matches it.
    """
    mark(builder)
    before = {shape: masks(builder, shape) for shape in shapes}
    for collision in collisions:
        found = find(names, collision.geoms, f"geom of {robot}")
        chosen = [names[geom] for geom in found]
        values = {
            name: resolve(chosen, getattr(collision, name), f"geom of {robot} among {collision.geoms!r}")
            for name in ("contype", "conaffinity", "condim", "priority", "friction", "solref", "solimp")
        }
        for index, geom in enumerate(found):
            mine: dict[str, Any] = {name: of_all[index] for name, of_all in values.items()}
            for name in ("contype", "conaffinity", "condim", "priority"):
                if mine[name] is None:
                    raise ValueError(
                        f"{robot}: no pattern of {name} in Collision({collision.geoms!r}) matches the geom {chosen[index]}; add '*' as the last one"
                    )
            _set_contact(builder, shapes[geom], mine)
        if collision.only:
            for geom in set(range(len(names))) - set(found):
                _set_masks(builder, shapes[geom], 0, 0)
    _drop_stale_filters(builder, before)


def mark(builder: newton.ModelBuilder) -> None:
    """Give MuJoCo's default masks to colliding shapes without masks, such as those of URDF and USD files and of objects."""
    for shape, flags in enumerate(builder.shape_flags):
        if flags & newton.ShapeFlags.COLLIDE_SHAPES and masks(builder, shape) is None:
            _set_masks(builder, shape, 1, 1)


def masks(builder: newton.ModelBuilder, shape: int) -> tuple[int, int] | None:
    """``contype`` and ``conaffinity`` of a shape; None: it has none."""
    pair = [_values(builder, name).get(shape, UNSET) for name in ("contype", "conaffinity")]
    return None if UNSET in pair else (int(pair[0]), int(pair[1]))


def without_self(builder: newton.ModelBuilder, world: newton.ModelBuilder) -> None:
    """Disable self-collisions of a builder's one robot; it still collides with the rest of the ``world``, and with robots added later."""
    taken = {int(mask) for mask in _values(world, "contype").values() if mask != UNSET}
    bit = next(1 << bit for bit in range(FIRST_OWN_BIT, 31) if not any(mask >> bit & 1 for mask in taken))
    for shape, flags in enumerate(builder.shape_flags):
        pair = masks(builder, shape)
        if flags & newton.ShapeFlags.COLLIDE_SHAPES and pair is not None and pair != (0, 0):
            _set_masks(builder, shape, bit, (2**31 - 1) & ~bit)


def share(template: newton.ModelBuilder) -> bool:
    """Give the masks of all shapes in a world one meaning, so that Newton can pass them to MuJoCo unchanged.

    Newton does that only for shapes of one file. Otherwise it derives masks from its own groups, which can't distinguish ``contype`` from
    ``conaffinity``.

    Returns:
        Whether all colliding shapes have masks. If some were added without masks, the world is left unchanged.
    """
    colliding = [shape for shape, flags in enumerate(template.shape_flags) if flags & newton.ShapeFlags.COLLIDE_SHAPES]
    if any(masks(template, shape) is None for shape in colliding):
        return False
    _values(template, "collision_mask_domain").update(dict.fromkeys(colliding, 0))
    return True


def share_ground(scene: newton.ModelBuilder) -> None:
    """Give the ground shared by all worlds masks with the same meaning as theirs, replicates of a template for which :func:`share` is true."""
    domains = _values(scene, "collision_mask_domain")
    # a world's domain is its first shape that collides; MuJoCo's model is made of the first world and the ground
    first = next((shape for shape in sorted(domains) if scene.shape_world[shape] == 0), None)
    for shape, world in enumerate(scene.shape_world):
        if world == -1 and scene.shape_flags[shape] & newton.ShapeFlags.COLLIDE_SHAPES:
            _set_masks(scene, shape, *(masks(scene, shape) or (1, 1)))
            if first is not None:
                domains[shape] = domains[first]


def _values(builder: newton.ModelBuilder, name: str) -> dict[int, Any]:
    attribute = builder.custom_attributes[f"mujoco:{name}"]
    if attribute.values is None:
        attribute.values = {}
    assert isinstance(attribute.values, dict)  # a list belongs to an attribute with a frequency of its own
    return attribute.values


def _set_masks(builder: newton.ModelBuilder, shape: int, contype: int, conaffinity: int) -> None:
    _values(builder, "contype")[shape] = contype
    _values(builder, "conaffinity")[shape] = conaffinity
    _values(builder, "collision_mask_domain")[shape] = 0
    if contype or conaffinity:
        builder.shape_flags[shape] |= newton.ShapeFlags.COLLIDE_SHAPES
        builder.shape_collision_group[shape] = builder.shape_collision_group[shape] or 1
    else:
        builder.shape_collision_group[shape] = 0


def _set_contact(builder: newton.ModelBuilder, shape: int, values: Mapping[str, Any]) -> None:
    _set_masks(builder, shape, values["contype"], values["conaffinity"])
    _values(builder, "condim")[shape] = values["condim"]
    _values(builder, "geom_priority")[shape] = values["priority"]
    if values["friction"] is not None:
        friction = values["friction"] if isinstance(values["friction"], Sequence) else (values["friction"],)
        for coefficient, direction in zip(friction, ("", "_torsional", "_rolling"), strict=False):
            getattr(builder, f"shape_material_mu{direction}")[shape] = float(coefficient)
    if values["solref"] is not None:
        _values(builder, "solref")[shape] = wp.vec2(*values["solref"])
        _values(builder, "solref_mode")[shape] = SOLREF_AS_WRITTEN
    if values["solimp"] is not None:
        solimp = tuple(values["solimp"]) + SOLIMP_DEFAULT[len(values["solimp"]) :]
        _values(builder, "geom_solimp")[shape] = wp.types.vector(5, wp.float32)(*solimp)


def _drop_stale_filters(builder: newton.ModelBuilder, before: Mapping[int, tuple[int, int] | None]) -> None:
    """Remove the pair filters that an importer derived from the file's masks, since new masks replace those."""
    parents = {frozenset(pair) for pair in zip(builder.joint_parent, builder.joint_child, strict=True)}

    def is_stale(first: int, second: int) -> bool:
        bodies = frozenset((builder.shape_body[first], builder.shape_body[second]))
        one, other = before.get(first), before.get(second)
        return len(bodies) > 1 and bodies not in parents and bool(one and other and not _touch(one, other))

    pairs = builder.shape_collision_filter_pairs
    builder.shape_collision_filter_pairs = [pair for pair in pairs if not is_stale(*pair)]


def _touch(first: tuple[int, int], second: tuple[int, int]) -> bool:
    return bool(first[0] & second[1] or second[0] & first[1])
