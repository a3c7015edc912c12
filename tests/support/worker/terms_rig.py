"""Calls terms in small worlds of random numbers: one kernel a term, all kernels of a test file in one module that is compiled once."""

from __future__ import annotations

import contextlib
import importlib.util
import inspect
import typing
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
import warp as wp

from worker.simulation.episodes import EpisodeArrays
from worker.simulation.robot_arrays import BodyArrays, RobotArrays
from worker.simulation.worlds import WorldArrays
from worker.tasks import terms as library
from worker.tasks.terms.aliases import all_terms

WORLDS, JOINTS, BODIES, ACTIONS, MEMORY = 3, 5, 7, 4, 40
ROOT, ROOT_DOF = 2, 2  # two sliders of something else come first
OBJECT, OBJECT_DOF = ROOT + 7 + JOINTS, ROOT_DOF + 6 + JOINTS
ROOT_BODY, OBJECT_BODY = 1, 6
SECONDS = 0.02

ELEMENTS = ("joint", "body", "index", "action")
WIDTHS = {float: 1, int: 1, bool: 1, wp.vec2: 2, wp.vec3: 3, wp.quat: 4}
READS = {
    float: "numbers[{0}]",
    int: "int(numbers[{0}])",
    bool: "(numbers[{0}] != 0.0)",
    wp.vec2: "wp.vec2(numbers[{0}], numbers[{0} + 1])",
    wp.vec3: "wp.vec3(numbers[{0}], numbers[{0} + 1], numbers[{0} + 2])",
}


def terms_of(*groups: str) -> list[str]:
    """Names of the terms of these groups."""
    return [name for group, name, _ in all_terms() if group in groups]


def close(found: np.ndarray, requested: Any, name: str = "", *, rtol: float = 1e-4, atol: float = 2e-5) -> None:
    """Judge numbers in float32."""
    np.testing.assert_allclose(found, np.asarray(requested, dtype=float), rtol=rtol, atol=atol, err_msg=name)


def rotations(random: np.random.Generator, *shape: int) -> np.ndarray:
    """Unit quaternions, of any rotation and either sign."""
    found = random.normal(size=(*shape, 4))
    units: np.ndarray = found / np.linalg.norm(found, axis=-1, keepdims=True)
    return units


def matrix(rotation: Any) -> np.ndarray:
    """Rotation matrices of quaternions xyzw, shape ``(..., 3, 3)``."""
    x, y, z, w = np.moveaxis(np.asarray(rotation, dtype=float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    found: np.ndarray = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return found


def array(values: Any, dtype: Any = wp.float32) -> wp.array[Any]:
    """A Warp array on the CPU."""
    kinds = {wp.int32: np.int32, wp.bool: np.bool_}
    return wp.array(np.asarray(values, dtype=kinds.get(dtype, np.float32)), dtype=dtype, device="cpu")


def robot(random: np.random.Generator, *, joints: int, coordinate: int, dof: int, body: int) -> RobotArrays:
    """A robot with a free root; its joints' columns are not in order, and its last joint has no actuator and no limits."""
    arrays = RobotArrays()
    arrays.root_coordinate, arrays.root_dof, arrays.root_body = coordinate, dof, body
    order = random.permutation(joints)
    arrays.coordinates = array(coordinate + 7 + order, wp.int32)
    arrays.dofs = array(dof + 6 + order, wp.int32)
    arrays.actuators = array([*random.permutation(joints - 1), -1] if joints else [], wp.int32)
    arrays.defaults = array(random.uniform(-1, 1, joints))
    lower, upper = random.uniform(-2, 0, joints), random.uniform(0.2, 2, joints)
    efforts = random.uniform(0.5, 3, joints)
    if joints:
        lower[-1], upper[-1], efforts[-1] = -np.inf, np.inf, np.inf
    arrays.ranges = array(np.stack([lower, upper], axis=1).reshape(-1, 2), wp.vec2)
    arrays.references = array(random.uniform(-0.5, 0.5, joints))
    arrays.efforts = array(efforts)
    arrays.gains = array(random.choice([-1.0, 1.0], joints) * random.uniform(0.5, 3, joints))
    arrays.encoder_bias = array(random.uniform(-0.1, 0.1, (WORLDS, joints)))
    arrays.start = wp.transform(wp.vec3(*random.normal(size=3)), wp.quat(*rotations(random)))
    return arrays


class Rig:
    """Random worlds with a robot, an object and bodies; ``call`` evaluates a term in all of them.

    Args:
        terms: Names, all compiled at once.
        folder: Where the module of kernels is written.
        structs: Further structs by type, such as those of sensors; random numbers are up to the caller.
        seed: Of the random numbers.
    """

    def __init__(self, terms: list[str], folder: Path, structs: dict[Any, Any] | None = None, seed: int = 1) -> None:
        random = self.random = np.random.default_rng(seed)
        worlds, episodes, bodies = WorldArrays(), EpisodeArrays(), BodyArrays()
        self.q = random.normal(size=(WORLDS, OBJECT + 7)).astype(np.float32)
        for first in (ROOT, OBJECT):
            rotation = rotations(random, WORLDS)
            rotation *= np.sign(rotation[:, 3:]) * np.array([[1], [-1], [1]])  # both signs of w
            self.q[:, first + 3 : first + 7] = rotation
        self.qd = random.normal(size=(WORLDS, OBJECT_DOF + 6)).astype(np.float32)
        worlds.joint_q, worlds.joint_qd = array(self.q), array(self.qd)
        worlds.controls = array(np.zeros((WORLDS, ACTIONS)))
        worlds.drives = array(2 * random.normal(size=self.qd.shape))
        worlds.warm_start = array(random.normal(size=self.qd.shape))
        for name in ("actions", "last_actions", "earlier_actions"):
            setattr(episodes, name, array(random.normal(size=(WORLDS, ACTIONS))))
        episodes.memory = array(random.normal(size=(WORLDS, MEMORY)))
        episodes.ages = array([0, 7, 100], wp.int32)
        episodes.level = array([0.5])
        episodes.random = array([[3, world, 0] for world in range(WORLDS)], wp.int32)
        poses = np.concatenate([random.normal(size=(WORLDS, BODIES, 3)), rotations(random, WORLDS, BODIES)], axis=-1)
        bodies.poses = array(poses, wp.transform)
        bodies.velocities = array(random.normal(size=(WORLDS, BODIES, 6)), wp.spatial_vector)
        bodies.coms = array(0.3 * random.normal(size=(WORLDS, BODIES, 3)), wp.vec3)
        self.robot = robot(random, joints=JOINTS, coordinate=ROOT, dof=ROOT_DOF, body=ROOT_BODY)
        self.other = robot(random, joints=0, coordinate=OBJECT, dof=OBJECT_DOF, body=OBJECT_BODY)
        self.worlds, self.episodes, self.bodies = worlds, episodes, bodies
        self.structs = {WorldArrays: worlds, EpisodeArrays: episodes, BodyArrays: bodies} | (structs or {})
        self._signatures: dict[str, dict[str, Any]] = {}
        self._kernels = self._compile(terms, folder)

    @contextlib.contextmanager
    def kept(self) -> Iterator[Self]:
        """All arrays are afterwards as they were, whatever is written meanwhile."""
        structs = [*self.structs.items(), (RobotArrays, self.robot)]
        arrays = [(each, name, getattr(each, name)) for kind, each in structs for name in kind.cls.__annotations__]
        before = [
            (*each, each[-1].numpy().copy()) for each in arrays if isinstance(each[-1], wp.array) and each[-1].size
        ]
        yield self
        for struct, name, array_of, values in before:
            array_of.assign(values)
            setattr(struct, name, array_of)

    def root(self) -> SimpleNamespace:
        """What the root is and does, by numpy."""
        turn = matrix(self.q[:, ROOT + 3 : ROOT + 7])
        yaw = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
        linear, angular = self.qd[:, ROOT_DOF : ROOT_DOF + 3], self.qd[:, ROOT_DOF + 3 : ROOT_DOF + 6]
        arm = np.einsum("wij,wj->wi", turn, self.bodies.coms.numpy()[:, ROOT_BODY])
        origin = linear - np.cross(angular, arm)
        seen = {"origin": origin, "linear": linear, "angular": angular}
        own = {f"own_{name}": np.einsum("wji,wj->wi", turn, each) for name, each in seen.items()}
        return SimpleNamespace(turn=turn, yaw=yaw, **seen, **own)

    def call(self, name: str, element: int = 0, *, robot: RobotArrays | None = None, **numbers: Any) -> np.ndarray:
        """What a term gives in each world, shape ``(worlds,)`` or ``(worlds, numbers)``; a bool is 0 or 1.

        Args:
            name: One of the terms that the rig was made with.
            element: Its joint, body, index or action.
            robot: Instead of the rig's own.
            **numbers: Its numbers; those with a default can be left out. ``command`` and ``memory`` are columns, ``stream`` a seed.
        """
        term = getattr(library, name)
        parameters = self._signatures[name]
        defaults = {key: value.default for key, value in inspect.signature(term.func).parameters.items()}
        flat: list[float] = []
        for key, kind in parameters.items():
            if kind in WIDTHS and key not in ("world", *ELEMENTS):
                value = numbers.pop(key) if key in numbers else {"seconds": SECONDS}.get(key, defaults[key])
                assert value is not inspect.Parameter.empty, f"{name} needs {key}"
                flat += [float(each) for each in (np.atleast_1d(value) if not hasattr(value, "__len__") else value)]
        seed = numbers.pop("stream", 0)
        assert not numbers, f"{name} has no {', '.join(numbers)}"
        out = wp.zeros((WORLDS, 7), dtype=wp.float32, device="cpu")
        inputs = [*self.structs.values(), robot or self.robot, self.other, element, seed, array(flat or [0.0]), out]
        wp.launch(getattr(self._kernels, f"call_{name}"), dim=WORLDS, inputs=inputs, device="cpu")
        returns = typing.get_type_hints(term.func).get("return", type(None))
        width = WIDTHS.get(returns, 0)
        found: np.ndarray = out.numpy().astype(np.float64)
        return found[:, 0] if width == 1 else found[:, :width]

    def _compile(self, names_of_terms: list[str], folder: Path) -> Any:
        terms = [getattr(library, name) for name in names_of_terms]
        kinds = list(self.structs)
        names = {kind: f"struct_{number}" for number, kind in enumerate(kinds)}
        modules = sorted({kind.cls.__module__ for kind in [*kinds, RobotArrays]})
        lines = ["import warp as wp", *(f"import {module}" for module in modules)]
        for term in terms:
            lines.append(f"from {term.func.__module__} import {term.func.__name__}")
        lines.append("wp.set_module_options({'enable_backward': False})")
        typed = [f"{names[kind]}: {kind.cls.__module__}.{kind.cls.__name__}" for kind in kinds]
        robots = [f"{each}: worker.simulation.robot_arrays.RobotArrays" for each in ("robot", "other")]
        rest = ["element: int", "seed: int", "numbers: wp.array[float]", "out: wp.array2d[float]"]
        for term in terms:
            lines += ["", "@wp.kernel", f"def call_{term.key}({', '.join([*typed, *robots, *rest])}):"]
            lines += ["    world = wp.tid()", *(f"    {line}" for line in self._call(term, names))]
        path = folder / "kernels_of_terms.py"
        path.write_text("\n".join(lines) + "\n")
        spec = importlib.util.spec_from_file_location(f"kernels_of_terms_{folder.name}", path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    def _call(self, term: Any, names: dict[Any, str]) -> list[str]:
        hints = typing.get_type_hints(term.func)
        returns = hints.pop("return", type(None))
        self._signatures[term.key] = hints
        arguments, first, robots = [], 0, iter(("robot", "other"))
        for name, kind in hints.items():
            if name == "world":
                arguments.append("world")
            elif name in ELEMENTS:
                arguments.append("element")
            elif kind is RobotArrays:
                arguments.append(next(robots))
            elif kind in names:
                arguments.append(names[kind])
            elif kind is wp.uint32:
                arguments.append("wp.rand_init(seed, world)")
            else:
                arguments.append(READS[kind].format(first))
                first += WIDTHS[kind]
        call = f"{term.func.__name__}({', '.join(arguments)})"
        if returns is type(None):
            return [call]
        if returns is bool:
            return [f"out[world, 0] = wp.where({call}, 1.0, 0.0)"]
        if returns is float:
            return [f"out[world, 0] = {call}"]
        return [f"value = {call}", f"for axis in range({WIDTHS[returns]}):", "    out[world, axis] = value[axis]"]
