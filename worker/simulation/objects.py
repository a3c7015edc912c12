"""Objects of a scene: boxes, spheres and capsules, free to move or fixed to the world."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import newton
import warp as wp

from worker.simulation.collisions import mark
from worker.simulation.robot import UPRIGHT, check_name
from worker.simulation.robot_elements import empty_builder


@dataclass(frozen=True)
class Object:
    """Arguments common to all objects. Each is one body with one geom, and both bear its name.

    Args:
        name: Its name in the world.
        mass: [kg].
        position: Of its centre at the start [m].
        rotation: At the start (quaternion xyzw).
        color: Red, green and blue, each from 0 to 1; None: Newton chooses.
        friction: Sliding coefficient.
        fixed: Whether it is fixed to the world.
    """

    name: str
    mass: float = field(default=1.0, kw_only=True)
    position: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), kw_only=True)
    rotation: tuple[float, float, float, float] = field(default=UPRIGHT, kw_only=True)
    color: tuple[float, float, float] | None = field(default=None, kw_only=True)
    friction: float = field(default=1.0, kw_only=True)
    fixed: bool = field(default=False, kw_only=True)

    lengths: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for name in ("mass", *self.lengths):
            value = getattr(self, name)
            for number in value if isinstance(value, tuple) else (value,):
                if not 0.0 < number < math.inf:
                    raise ValueError(
                        f"{type(self).__name__} {self.name!r}: {name} must be greater than 0, not {value!r}"
                    )
        if self.friction < 0.0:
            raise ValueError(f"{type(self).__name__} {self.name!r}: friction must be 0 or more, not {self.friction!r}")

    def volume(self) -> float:
        """[m^3]."""
        raise NotImplementedError

    def add_shape(self, builder: newton.ModelBuilder, body: int, **arguments: Any) -> None:
        """Add its geom to its body."""
        raise NotImplementedError

    def add_to(self, builder: newton.ModelBuilder) -> None:
        """Add the object to a builder that holds one world.

        Args:
            builder: As of :func:`worker.simulation.robot_elements.empty_builder`.

        Raises:
            ValueError: The name is taken.
        """
        check_name(builder, self.name)
        own = empty_builder()
        pose = wp.transform(wp.vec3(*self.position), wp.normalize(wp.quat(*self.rotation)))
        body = own.add_link(xform=pose, label=self.name)
        material = newton.ModelBuilder.ShapeConfig(density=self.mass / self.volume(), mu=self.friction)
        self.add_shape(own, body, cfg=material, color=self.color, label=self.name)
        if self.fixed:
            joint = own.add_joint_fixed(parent=-1, child=body, parent_xform=pose, label="root")
        else:
            joint = own.add_joint_free(child=body, label="root")
        own.add_articulation([joint], label=self.name)
        mark(own)
        builder.add_builder(own, label_prefix=self.name)


@dataclass(frozen=True)
class Box(Object):
    """A box.

    Args:
        size: Lengths of its edges along x, y and z [m].
    """

    size: tuple[float, float, float] = (0.1, 0.1, 0.1)
    lengths: ClassVar[tuple[str, ...]] = ("size",)

    def volume(self) -> float:
        return self.size[0] * self.size[1] * self.size[2]

    def add_shape(self, builder: newton.ModelBuilder, body: int, **arguments: Any) -> None:
        builder.add_shape_box(body, hx=self.size[0] / 2, hy=self.size[1] / 2, hz=self.size[2] / 2, **arguments)


@dataclass(frozen=True)
class Sphere(Object):
    """A sphere.

    Args:
        radius: [m].
    """

    radius: float = 0.05
    lengths: ClassVar[tuple[str, ...]] = ("radius",)

    def volume(self) -> float:
        return 4.0 / 3.0 * math.pi * self.radius**3

    def add_shape(self, builder: newton.ModelBuilder, body: int, **arguments: Any) -> None:
        builder.add_shape_sphere(body, radius=self.radius, **arguments)


@dataclass(frozen=True)
class Capsule(Object):
    """A capsule along its z axis.

    Args:
        radius: [m].
        length: Of its cylinder, without the round ends [m].
    """

    radius: float = 0.05
    length: float = 0.1
    lengths: ClassVar[tuple[str, ...]] = ("radius", "length")

    def volume(self) -> float:
        return math.pi * self.radius**2 * (self.length + 4.0 / 3.0 * self.radius)

    def add_shape(self, builder: newton.ModelBuilder, body: int, **arguments: Any) -> None:
        builder.add_shape_capsule(body, radius=self.radius, half_height=self.length / 2, **arguments)
