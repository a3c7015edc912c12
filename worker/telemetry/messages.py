"""The messages of a recording, all of them CDR: ROS 2's own types, Foxglove's scenes as ROS 2 knows them, and one type of Muster's."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

STEP = "muster_msgs/msg/Step"
STEP_DEFINITION = """\
# One control step of one world, as a policy and its task see it.
std_msgs/Header header          # time after the step [simulated]; frame_id: that of the world
uint32 world                    # index of the world
uint32 episode                  # episodes of this world that ended before this step, since the recording began
uint32 age                      # steps on the clock of the episode after this step; 0 where the next one has begun
bool done                       # whether this step ended the episode
bool time_out                   # whether it was the clock alone that ended it
float32 reward                  # sum of the terms
string[] reward_names
float32[] reward_terms          # weighted
string[] action_names
float32[] action                # what the policy asked for
string[] observation_names
float32[] observation           # what it sees next; of an episode that has ended, the first of the next one
"""
SCENE = "foxglove_msgs/msg/SceneUpdate"
_POSE, _COLOR = "geometry_msgs/Pose pose", "foxglove_msgs/Color color"
_SIZE, _POINTS = "geometry_msgs/Vector3 size", "geometry_msgs/Point[] points"
_COLORS = "foxglove_msgs/Color[] colors;uint32[] indices"
_ARROW = ";".join(f"float64 {part}" for part in ("shaft_length", "shaft_diameter", "head_length", "head_diameter"))
_PRIMITIVES = {
    "Arrow": ("arrows", f"{_POSE};{_ARROW};{_COLOR}"),
    "Cube": ("cubes", f"{_POSE};{_SIZE};{_COLOR}"),
    "Sphere": ("spheres", f"{_POSE};{_SIZE};{_COLOR}"),
    "Cylinder": ("cylinders", f"{_POSE};{_SIZE};float64 bottom_scale;float64 top_scale;{_COLOR}"),
    "Line": ("lines", f"uint8 type;{_POSE};float64 thickness;bool scale_invariant;{_POINTS};{_COLOR};{_COLORS}"),
    "TriangleList": ("triangles", f"{_POSE};{_POINTS};{_COLOR};{_COLORS}"),
    "Text": ("texts", f"{_POSE};bool billboard;float64 font_size;bool scale_invariant;{_COLOR};string text"),
    "Model": (
        "models",
        f"{_POSE};geometry_msgs/Vector3 scale;{_COLOR};bool override_color;string url;string media_type;uint8[] data",
    ),
}
_SCENE_TYPES = {
    "Color": "float64 r;float64 g;float64 b;float64 a",
    "KeyValuePair": "string key;string value",
    "SceneEntityDeletion": "builtin_interfaces/Time timestamp;uint8 type;string id",
    **{f"{kind}Primitive": fields for kind, (_, fields) in _PRIMITIVES.items()},
    "SceneEntity": "builtin_interfaces/Time timestamp;string frame_id;string id;builtin_interfaces/Duration lifetime;"
    "bool frame_locked;foxglove_msgs/KeyValuePair[] metadata;"
    + ";".join(f"foxglove_msgs/{kind}Primitive[] {name}" for kind, (name, _) in _PRIMITIVES.items()),
    "SceneUpdate": "foxglove_msgs/SceneEntityDeletion[] deletions;foxglove_msgs/SceneEntity[] entities",
}
"""Fields of Foxglove's scenes: names and types are those of its ROS 2 package ``foxglove_msgs``, by which viewers know them."""


@cache
def types() -> Any:
    """The type store: that of ROS 2 Jazzy, Foxglove's scenes, and Muster's own."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    for name, fields in _SCENE_TYPES.items():
        store.register(get_types_from_msg(fields.replace(";", "\n"), f"foxglove_msgs/msg/{name}"))
    store.register(get_types_from_msg(STEP_DEFINITION, STEP))
    return store


def definition(name: str) -> str:
    """The text of a type with all that it is made of, as MCAP has it (``ros2msg``)."""
    text: str = types().generate_msgdef(name, ros_version=2)[0]
    return text


def encoded(name: str, /, **fields: Any) -> bytes:
    """A message of type ``name`` as CDR."""
    message = types().types[name](**fields)
    return bytes(types().serialize_cdr(message, name))


def stamp(nanoseconds: int) -> Any:
    """A ``builtin_interfaces/Time``."""
    seconds, rest = divmod(nanoseconds, 10**9)
    return types().types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)


def header(nanoseconds: int, frame: str) -> Any:
    """A ``std_msgs/Header``."""
    return types().types["std_msgs/msg/Header"](stamp=stamp(nanoseconds), frame_id=frame)


def transforms(nanoseconds: int, frames: Sequence[tuple[str, str, Sequence[float]]]) -> bytes:
    """A ``tf2_msgs/TFMessage``.

    Args:
        nanoseconds: When [ns].
        frames: Parent, child, and the child's pose in it: position [m] and quaternion xyzw.
    """
    known = types().types
    transform, vector = known["geometry_msgs/msg/Transform"], known["geometry_msgs/msg/Vector3"]
    quaternion, stamped = known["geometry_msgs/msg/Quaternion"], known["geometry_msgs/msg/TransformStamped"]
    made = [
        stamped(
            header=header(nanoseconds, parent),
            child_frame_id=child,
            transform=transform(translation=vector(x=x, y=y, z=z), rotation=quaternion(x=i, y=j, z=k, w=w)),
        )
        for parent, child, (x, y, z, i, j, k, w) in frames
    ]
    return encoded("tf2_msgs/msg/TFMessage", transforms=made)


def joint_states(
    nanoseconds: int, frame: str, names: list[str], positions: np.ndarray, velocities: np.ndarray
) -> bytes:
    """A ``sensor_msgs/JointState``; without efforts, which the tap does not have."""
    return encoded(
        "sensor_msgs/msg/JointState",
        header=header(nanoseconds, frame),
        name=names,
        position=positions.astype(np.float64),
        velocity=velocities.astype(np.float64),
        effort=np.zeros(0),
    )


def log(nanoseconds: int, level: int, name: str, text: str) -> bytes:
    """A ``rcl_interfaces/Log``; levels: 20 information, 30 warning, 40 error."""
    of_log = {"name": name, "msg": text, "file": "", "function": "", "line": 0}
    return encoded("rcl_interfaces/msg/Log", stamp=stamp(nanoseconds), level=level, **of_log)


def png(image: np.ndarray) -> np.ndarray:
    """The bytes of an image, uint8, shape ``(height, width, 3)`` or ``(height, width)``, as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", compress_level=1)
    return np.frombuffer(buffer.getvalue(), np.uint8)


def tiled(images: Sequence[np.ndarray] | np.ndarray, columns: int, gap: int = 0, ground: int = 255) -> np.ndarray:
    """Images of one size row by row in one, ``gap`` [px] from each other, on a ground of one brightness; uint8."""
    height, width, *channels = images[0].shape
    high, wide, rows = height + gap, width + gap, math.ceil(len(images) / columns)
    whole = np.full((rows * high - gap, columns * wide - gap, *channels), ground, np.uint8)
    for number, image in enumerate(images):
        top, left = number // columns * high, number % columns * wide
        whole[top : top + height, left : left + width] = image
    return whole


def compressed_image(nanoseconds: int, frame: str, image: np.ndarray) -> bytes:
    """A ``sensor_msgs/CompressedImage`` of an image as :func:`png` takes it."""
    kind = "sensor_msgs/msg/CompressedImage"
    return encoded(kind, header=header(nanoseconds, frame), format="png", data=png(image))


def scene(nanoseconds: int, models: Mapping[str, bytes]) -> bytes:
    """A ``foxglove_msgs/SceneUpdate``: a model on each frame, which moves with it.

    Args:
        nanoseconds: When [ns].
        models: Binary glTF by frame.
    """
    known = types().types
    point, vector = known["geometry_msgs/msg/Point"], known["geometry_msgs/msg/Vector3"]
    turn = known["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    here = known["geometry_msgs/msg/Pose"](position=point(x=0.0, y=0.0, z=0.0), orientation=turn)
    plain = known["foxglove_msgs/msg/Color"](r=1.0, g=1.0, b=1.0, a=1.0)
    primitives: dict[str, list[Any]] = {name: [] for name, _ in _PRIMITIVES.values()}
    entities = []
    for frame, data in models.items():
        model = known["foxglove_msgs/msg/ModelPrimitive"](
            pose=here,
            scale=vector(x=1.0, y=1.0, z=1.0),
            color=plain,
            override_color=False,
            url="",
            media_type="model/gltf-binary",
            data=np.frombuffer(data, np.uint8),
        )
        entity = known["foxglove_msgs/msg/SceneEntity"](
            timestamp=stamp(nanoseconds),
            frame_id=frame,
            id=frame,
            lifetime=known["builtin_interfaces/msg/Duration"](sec=0, nanosec=0),  # for ever
            frame_locked=True,
            metadata=[],
            **{**primitives, "models": [model]},
        )
        entities.append(entity)
    return encoded(SCENE, deletions=[], entities=entities)
