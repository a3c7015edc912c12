"""The stage of a task's worlds, their appearance without physics: link frames from joint coordinates, and the shapes on the links."""

from __future__ import annotations

import dataclasses
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import worker.simulation  # noqa: F401 - before Newton, which it keeps from importing Rerun

# isort: split
import newton
import numpy as np
import warp as wp

from shared_store.volume.layout import Run
from worker.learning.job import configure, user_errors, with_texts
from worker.settings.errors import UserError
from worker.simulation import robot_files
from worker.simulation.robot_elements import empty_builder, is_carrier
from worker.simulation.robot_view import RobotView
from worker.simulation.structs import numbers
from worker.simulation.terrain import Terrain
from worker.tasks import find_task
from worker.tasks.run.task import Task

if TYPE_CHECKING:
    from worker.settings.task import TaskConfig
    from worker.tasks.run.task import Task

APART = 3.0
"""Between the origins of two worlds, along y [m]; a viewer shows them side by side."""
_GROUND = (0.6, 0.62, 0.6)
"""Its colour."""


class Stage:
    """Some worlds of a task as they are seen: with the shapes that a robot's file has only for the eye.

    Args:
        task_type: The task.
        config: Its configuration.
        worlds: How many worlds.
        device: ``"cpu"`` or ``"cuda:<n>"``.

    Attributes:
        model: Newton's model of all worlds.
        state: Where the bodies are, after :meth:`pose`.
        links: Names of the links of one world, in the model's order: its bodies, without those that only carry a joint.
        link_of: Index of each link by that of its body in world 0.
        joints: Names of the joints with one degree of freedom.
        coordinates: Their columns among the joint coordinates.
        dofs: Their columns among the joint velocities.
        root: The link that a picture follows.
        robot_file: ``robot.urdf`` or ``robot.xml`` (MJCF) and the text of the robot's file; None of other kinds of files.

    Raises:
        ValueError: The robot can't be read.
    """

    def __init__(self, task_type: type[Task], config: TaskConfig, worlds: int, device: str = "cpu") -> None:
        sketch = _with_visuals(task_type).sketch(config)
        template = sketch.template
        self.worlds = worlds
        views: list[RobotView] = list(sketch.views.values())
        self.joints, self.coordinates, self.dofs = [], [], []
        for view in views:
            own = "" if view.name in ("", "robot") else f"{view.name}/"
            self.joints += [own + name for name in view.joint_names]
            self.coordinates += view.coordinates
            self.dofs += view.dofs
        bodies = [body for body, label in enumerate(template.body_label) if not is_carrier(label)]
        self.links = _link_names([template.body_label[body] for body in bodies])
        self.link_of = {body: link for link, body in enumerate(bodies)}
        self.root = self.link_of[views[0].root_body]
        scene = empty_builder()
        scene.replicate(template, worlds)
        stands_on, first = sketch.stands_on(), len(scene.shape_color)
        if isinstance(stands_on, Terrain):
            stands_on.add_to(scene)
        elif stands_on:
            scene.add_ground_plane()
        scene.shape_color[first:] = [_GROUND] * (len(scene.shape_color) - first)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Heightfield-vs-heightfield")  # nothing collides here
            self.model = scene.finalize(device=device)
        self.state = self.model.state()
        self.robot_file = _robot_file(sketch, config)
        self._apart = 0.0 if isinstance(stands_on, Terrain) else APART

    def places(self) -> np.ndarray:
        """Places of the worlds in the picture [m], shape ``(worlds, 3)``: beside each other along y, or their own places on a terrain."""
        places = np.zeros((self.worlds, 3))
        places[:, 1] = self._apart * (np.arange(self.worlds) - (self.worlds - 1) / 2)
        return places

    def pose(self, coordinates: np.ndarray) -> np.ndarray:
        """Put the worlds where joint coordinates say.

        Args:
            coordinates: Shape ``(worlds, coordinates)``.

        Returns:
            Poses of the links in the world's frame: position [m], quaternion xyzw; shape ``(worlds, links, 7)``.
        """
        joint_q, joint_qd = self.state.joint_q, self.state.joint_qd
        assert joint_q is not None and joint_qd is not None
        joint_q.assign(np.ascontiguousarray(coordinates, np.float32).reshape(-1))
        newton.eval_fk(self.model, joint_q, joint_qd, self.state)
        return numbers(self.state.body_q).reshape(self.worlds, -1, 7)[:, list(self.link_of)]

    def meshes(self) -> dict[str, bytes]:
        """The visible shapes of one world, each link in its own frame, as binary glTF (y up, as glTF has it).

        Returns:
            By link; ``""`` is what a world has that is fixed to it, ``"ground"`` what no world has for itself. A plane is a square of
            40 m.
        """
        import trimesh

        model = self.model
        bodies, owners, flags = numbers(model.shape_body), numbers(model.shape_world), numbers(model.shape_flags)
        kinds, sizes, places = numbers(model.shape_type), numbers(model.shape_scale), numbers(model.shape_transform)
        colors = numbers(model.shape_color)
        scenes: dict[str, Any] = {}
        for shape in range(model.shape_count):
            if owners[shape] > 0 or not flags[shape] & newton.ShapeFlags.VISIBLE:
                continue
            name = (
                "ground" if owners[shape] < 0 else "" if bodies[shape] < 0 else self.links[self.link_of[bodies[shape]]]
            )
            found = _mesh(int(kinds[shape]), sizes[shape], model.shape_source[shape])
            if found is None:
                continue
            vertices, faces = found
            rotation = np.array(wp.quat_to_matrix(wp.quat(*map(float, places[shape][3:])))).reshape(3, 3)
            x, y, z = (vertices @ rotation.T + places[shape][:3]).T
            material = trimesh.visual.material.PBRMaterial(
                baseColorFactor=[*(255 * np.clip(colors[shape], 0, 1)).astype(np.uint8).tolist(), 255],
                roughnessFactor=0.8,
                metallicFactor=0.0,
            )
            mesh = trimesh.Trimesh(np.stack([x, z, -y], 1), faces, process=False)
            mesh.visual = trimesh.visual.TextureVisuals(material=material)
            scenes.setdefault(name, trimesh.Scene()).add_geometry(mesh)
        return {name: scene.export(file_type="glb") for name, scene in scenes.items()}


def _with_visuals(task_type: type[Task]) -> type[Task]:
    """The task, with the geoms of its robots and objects that are only seen."""

    def shown(entity: Any) -> Any:
        return dataclasses.replace(entity, visuals=True) if hasattr(entity, "visuals") else entity

    def robot(self: Any, config: Any) -> Any:
        return shown(task_type.robot(self, config))

    def objects(self: Any, config: Any) -> Any:
        return {name: shown(each) for name, each in task_type.objects(self, config).items()}

    return type(task_type.__name__, (task_type,), {"robot": robot, "objects": objects})


def _robot_file(sketch: Task, config: TaskConfig) -> tuple[str, str] | None:
    """Name and text of the robot's file; None where it is binary, or the task has no such file."""
    file = getattr(sketch.robot(config), "file", None)
    if file is None:
        return None
    found = robot_files.read(file)
    if found.format not in ("urdf", "mjcf"):
        return None
    text = found.source if found.source.lstrip().startswith("<") else Path(found.source).read_text()
    return ("robot.urdf" if found.format == "urdf" else "robot.xml"), text


def _link_names(labels: list[str]) -> list[str]:
    """Short names of bodies; those of other robots and objects behind that of their owner, and the whole label of any that are alike."""
    found = []
    for label in labels:
        owner, short = label.partition("/")[0], label.rpartition("/")[2]
        found.append(short if owner in ("robot", short) or "/" not in label else f"{owner}/{short}")
    count = Counter(found)
    return [name if count[name] == 1 else label for name, label in zip(found, labels, strict=True)]


def _mesh(kind: int, size: np.ndarray, source: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices [m] and triangles of a shape in its own frame; None of what has no surface."""
    kinds, mesh = newton.GeoType, newton.Mesh
    if kind in (kinds.MESH, kinds.CONVEX_MESH):
        return np.asarray(source.vertices) * size, np.asarray(source.indices).reshape(-1, 3)
    first, second, third = (float(value) for value in size)
    upright = {"up_axis": newton.Axis.Z}
    makers: dict[int, tuple[Callable[..., Any], tuple[float, ...], dict[str, Any]]] = {
        kinds.PLANE: (mesh.create_plane, (first or 40.0, second or 40.0), {}),
        kinds.SPHERE: (mesh.create_sphere, (first,), {}),
        kinds.ELLIPSOID: (mesh.create_ellipsoid, (first, second, third), {}),
        kinds.CAPSULE: (mesh.create_capsule, (first, second), upright),
        kinds.CYLINDER: (mesh.create_cylinder, (first, second), upright),
        kinds.CONE: (mesh.create_cone, (first, second), upright),
        kinds.BOX: (mesh.create_box, (first, second, third), {}),
    }
    if kind == kinds.HFIELD:
        heights = source.min_z + np.asarray(source.data) * (source.max_z - source.min_z)
        # MuJoCo's rows are those along y
        sizes = heights.T, 2 * source.hx, 2 * source.hy
        maker: Any = (mesh.create_heightfield, sizes, {"ground_z": source.min_z - 0.1})
    elif (maker := makers.get(kind)) is None:
        return None
    create, arguments, options = maker
    made = create(*arguments, compute_inertia=False, **options)
    return np.asarray(made.vertices), np.asarray(made.indices).reshape(-1, 3)


def stage_of(run: Run, worlds: int) -> tuple[Stage, dict[str, Any]]:
    """The stage of a run's training worlds, and the ``train`` section of its job. Raises UserError."""
    wp.config.log_level = wp.LOG_WARNING  # not a line for each kernel module
    spec: dict[str, Any] = (run.description() or {}).get("spec") or {}
    train = spec.get("train")
    if not isinstance(train, dict) or not isinstance(train.get("task"), str):
        raise UserError(f"run {run.name}: its description names no task")
    train = with_texts(train, run, "train")
    with user_errors():
        task_type = find_task(train["task"])
        return Stage(task_type, configure(task_type, train), worlds), train
