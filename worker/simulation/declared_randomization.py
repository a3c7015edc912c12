"""The declared randomisation of physics, which differs between worlds: quantity, parts by pattern, range, and time of the draws.

>>> Randomize("friction", geoms="*_foot", range=(0.3, 1.2), operation="set")
>>> Randomize("center_of_mass", bodies="trunk", range={"x": (-0.025, 0.025), "z": (-0.03, 0.03)}, operation="add")
>>> Randomize("stiffness", actuators="*", range=(0.8, 1.25), distribution="log_uniform", when="reset")

:mod:`worker.simulation.randomizations` draws and applies it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Literal

from shared_store.contract.error_text import nearest

Pattern = str | tuple[str, ...]
Ends = tuple[float, float]
Operation = Literal["scale", "add", "set"]
Distribution = Literal["uniform", "log_uniform", "normal"]
When = Literal["startup", "reset", "interval"]

OPERATIONS = ("scale", "add", "set")
DISTRIBUTIONS = ("uniform", "log_uniform", "normal")
MOMENTS = ("startup", "reset", "interval")
PARTS = ("bodies", "geoms", "joints", "actuators")


@dataclass(frozen=True)
class Quantity:
    """A quantity that can be randomised.

    Args:
        parts: Kind of parts that a pattern selects, one of :data:`PARTS`; empty: the quantity belongs to the whole world.
        unit: Unit of its values, for ``add`` and ``set``.
        meaning: One line for a table.
        axes: Names of its components; empty for a single number.
        default_axes: Components drawn if the declaration names none; empty: one number for all of them.
        operations: Supported operations.
        signed: Whether its values can be negative; others are kept at 0 or above.
    """

    parts: str
    unit: str
    meaning: str
    axes: tuple[str, ...] = ()
    default_axes: tuple[str, ...] = ()
    operations: tuple[str, ...] = OPERATIONS
    signed: bool = False


_XYZ = ("x", "y", "z")
QUANTITIES: Mapping[str, Quantity] = {
    "mass": Quantity("bodies", "kg", "mass of a body; its inertia changes in proportion"),
    "center_of_mass": Quantity("bodies", "m", "centre of mass in the body's frame", _XYZ, _XYZ, signed=True),
    "inertia": Quantity(
        "bodies",
        "1",
        "inertia about the centre of mass at the same mass; along axes: the mass is stretched, so that it stays possible",
        _XYZ,
        operations=("scale",),
    ),
    "payload": Quantity(
        "bodies", "kg", "mass added at a point of a body; its centre of mass and inertia follow", operations=("add",)
    ),
    "friction": Quantity(
        "geoms", "1, m, m", "coefficients of friction of a geom", ("slide", "torsion", "roll"), ("slide",)
    ),
    "contact_friction": Quantity("geoms", "1", "all coefficients of friction of a geom", operations=("scale",)),
    "armature": Quantity("joints", "kg m^2, kg", "inertia of a joint's rotor"),
    "joint_damping": Quantity("joints", "N m s/rad, N s/m", "passive damping of a joint"),
    "joint_friction": Quantity(
        "joints", "N m, N", "dry friction of a joint; one that has none in the file needs a further row of njmax"
    ),
    "joint_limits": Quantity(
        "joints",
        "rad, m",
        "limits of a joint; terms see those of the file",
        ("lower", "upper"),
        ("lower", "upper"),
        signed=True,
    ),
    "encoder_bias": Quantity("joints", "rad, m", "what is added to a joint's measured position", signed=True),
    "stiffness": Quantity("actuators", "N m/rad, N/m", "gain on the position of a position actuator"),
    "damping": Quantity("actuators", "N m s/rad, N s/m", "gain on the velocity of a position or velocity actuator"),
    "effort_limit": Quantity("actuators", "N m, N", "greatest force of an actuator"),
    "motor_strength": Quantity("actuators", "1", "all that an actuator's force is made of", operations=("scale",)),
    "gravity": Quantity(
        "",
        "m/s^2",
        "acceleration of free fall, in the world frame; a factor without axes scales it all",
        _XYZ,
        ("z",),
        signed=True,
    ),
}
"""The quantities of :class:`Randomize`, by name."""


@dataclass(frozen=True)
class Randomize:
    """One quantity of some parts of a robot, drawn for each world.

    Entries on the same quantity of the same part are applied in the order of their declaration.

    Args:
        what: A name of :data:`QUANTITIES`.

    Raises:
        ValueError: An argument is invalid: the quantity is unknown or belongs to other parts, or the range is empty or would make a value
            impossible.
    """

    what: str
    _: KW_ONLY
    bodies: Pattern | None = None
    """Bodies, by name or pattern (``*`` for any letters)."""
    geoms: Pattern | None = None
    """Geoms, by name or pattern."""
    joints: Pattern | None = None
    """Joints of one degree of freedom, by name or pattern."""
    actuators: Pattern | None = None
    """Actuators, by the names of the joints that they drive."""
    range: Ends | Mapping[str, Ends]
    """Least and greatest drawn value, or for ``normal`` mean and standard deviation; or one pair per axis, by its name."""
    operation: Operation = "scale"
    """The operation by which the drawn number changes the model's original value; changes never compound."""
    distribution: Distribution = "uniform"
    """``log_uniform`` is uniform in the logarithm: half and double are equally likely."""
    when: When = "startup"
    """Drawn once when a world is built, at the beginning of each episode, or at intervals (and once at the beginning)."""
    seconds: Ends | None = None
    """For an interval: least and greatest time between two draws [s]."""
    shared: bool = False
    """One draw for all matched parts of a world, not one for each."""
    axes: tuple[str, ...] = ()
    """Drawn components, one draw each, such as ``("slide", "torsion")``; by default those of the quantity."""
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of a payload in the body's frame [m]."""
    robot: str | None = "robot"
    """Robot or object with these parts; None: all that have such parts, and with geoms the ground."""

    def __post_init__(self) -> None:
        if self.what not in QUANTITIES:
            raise ValueError(f"randomize: nothing is called {self.what!r}; {nearest(self.what, QUANTITIES)}")
        self._check_choice("operation", self.operation, self.quantity.operations)
        self._check_choice("distribution", self.distribution, DISTRIBUTIONS)
        self._check_choice("when", self.when, MOMENTS)
        self._check_parts()
        for axis in (*self.axes, *(self.range if isinstance(self.range, Mapping) else ())):
            if axis not in self.quantity.axes:
                hint = nearest(axis, self.quantity.axes) if self.quantity.axes else "it is one number"
                raise ValueError(f"{self._where}: it has no axis {axis!r}; {hint}")
        if isinstance(self.range, Mapping) and self.axes and set(self.axes) != set(self.range):
            raise ValueError(f"{self._where}: the range names other axes than axes={self.axes}; leave axes out")
        if isinstance(self.range, Mapping) and not self.range:
            raise ValueError(f"{self._where}: the range names no axis; available: {', '.join(self.quantity.axes)}")
        for ends in self.ends:
            self._check_range(ends)
        self._check_seconds()
        if self.what != "payload" and self.at != (0.0, 0.0, 0.0):
            raise ValueError(f"{self._where}: only a payload has a place, at={self.at}; leave it out")
        if len(self.at) != 3 or not all(map(math.isfinite, self.at)):
            raise ValueError(f"{self._where}: at={self.at} is not a point; give three finite numbers [m]")

    @property
    def quantity(self) -> Quantity:
        """The kind of :attr:`what`."""
        return QUANTITIES[self.what]

    @property
    def pattern(self) -> Pattern | None:
        """The pattern of the parts; None: the quantity belongs to the whole world."""
        return getattr(self, self.quantity.parts) if self.quantity.parts else None

    @property
    def drawn_axes(self) -> tuple[str, ...]:
        """The drawn components, in order; empty: one number for the whole."""
        named = self.range if isinstance(self.range, Mapping) else self.axes or self.quantity.default_axes
        return tuple(axis for axis in self.quantity.axes if axis in named)

    @property
    def ends(self) -> tuple[Ends, ...]:
        """The range of each drawn number of a part, at least one."""
        if isinstance(self.range, Mapping):
            return tuple(self.range[axis] for axis in self.drawn_axes)
        return (self.range,) * max(1, len(self.drawn_axes))

    @property
    def places(self) -> dict[str, int]:
        """Places of its numbers, such as ``range``, ``range.x`` and ``seconds``, and the count of each."""
        if isinstance(self.range, Mapping):
            found = {f"range.{axis}": 2 for axis in self.drawn_axes}
        else:
            found = {"range": 2 * len(self.ends)}
        return found | ({"seconds": 2} if self.when == "interval" else {})

    def check_numbers(self, place: str, values: Sequence[float]) -> None:
        """Check numbers that a job sets at one of :attr:`places`, as if they were declared. Raises ValueError."""
        for pair in zip(values[::2], values[1::2], strict=True):
            if place == "seconds":
                dataclasses.replace(self, seconds=pair)
            else:
                self._check_range(pair)

    @property
    def _where(self) -> str:
        return f"randomize {self.what}"

    def _check_choice(self, name: str, value: str, known: tuple[str, ...]) -> None:
        if value not in known:
            raise ValueError(f"{self._where}: {name} can't be {value!r}; {nearest(value, known)}")

    def _check_parts(self) -> None:
        expected = self.quantity.parts
        for parts in PARTS:
            if parts != expected and getattr(self, parts) is not None:
                instead = f"give {expected}=..." if expected else "it belongs to the whole world; leave it out"
                raise ValueError(f"{self._where}: {parts}={getattr(self, parts)!r} does not fit; {instead}")
        if expected and not getattr(self, expected):
            raise ValueError(f'{self._where}: {expected} is required; all of them are {expected}="*"')

    def _check_range(self, ends: Ends) -> None:
        shown = f"{self._where}: the range {ends!r}"
        if not isinstance(ends, tuple | list) or len(ends) != 2:
            raise ValueError(f"{shown} is not a pair; give two numbers, such as (0.8, 1.2)")
        low, high = ends
        if not (math.isfinite(low) and math.isfinite(high)):
            raise ValueError(f"{shown} is not finite")
        if self.distribution == "normal":
            if high < 0:
                raise ValueError(f"{shown} is a mean and a standard deviation, which can't be negative")
        elif low > high:
            raise ValueError(f"{shown} is empty: its first number is the lesser one")
        if self.distribution == "log_uniform" and low <= 0:
            raise ValueError(f"{shown} has no logarithm; log_uniform needs numbers above 0")
        needs_positive = self.what in ("mass", "inertia") and self.operation != "add"
        if needs_positive and low <= 0:
            raise ValueError(f"{shown} would make {self.what} {'negative' if low < 0 else 'zero'}; use numbers above 0")
        if low < 0 and (self.what == "payload" or (self.operation != "add" and not self.quantity.signed)):
            hint = " (to take mass away: what='mass', operation='add')" if self.what == "payload" else ""
            raise ValueError(f"{shown} would make {self.what} negative; use numbers from 0 on{hint}")

    def _check_seconds(self) -> None:
        if (self.when == "interval") != (self.seconds is not None):
            instead = (
                "is required, such as seconds=(10.0, 15.0)" if self.seconds is None else "is for when='interval' alone"
            )
            raise ValueError(f"{self._where}: seconds {instead}")
        if self.seconds is not None and not 0 < self.seconds[0] <= self.seconds[1] < math.inf:
            raise ValueError(
                f"{self._where}: seconds={self.seconds} is not an interval; give two times above 0, the lesser first"
            )
