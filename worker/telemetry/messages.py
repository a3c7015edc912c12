"""The messages of a recording: ROS 2's own types as CDR, one type of Muster's, and Foxglove's scenes."""

from __future__ import annotations

from collections.abc import Sequence
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


@cache
def types() -> Any:
    """The type store: that of ROS 2 Jazzy, and Muster's own."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
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


def transforms(nanoseconds: int, parent: str, children: Sequence[str], poses: np.ndarray) -> bytes:
    """A ``tf2_msgs/TFMessage``: frames in their parent.

    Args:
        nanoseconds: When [ns].
        parent: Name of the frame that they are in.
        children: Their names.
        poses: Position [m] and quaternion xyzw, shape ``(children, 7)``.
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
        for child, (x, y, z, i, j, k, w) in zip(children, poses.tolist(), strict=True)
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


def picture(nanoseconds: int, frame: str, image: np.ndarray) -> bytes:
    """A ``sensor_msgs/CompressedImage`` (PNG) of an image, uint8, shape ``(height, width, 3)`` or ``(height, width)``."""
    import io

    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", compress_level=1)
    data = np.frombuffer(buffer.getvalue(), np.uint8)
    return encoded("sensor_msgs/msg/CompressedImage", header=header(nanoseconds, frame), format="png", data=data)


@cache
def scene_schema() -> tuple[str, bytes]:
    """Name and schema of Foxglove's scenes: all files that define it, as a protobuf descriptor set."""
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    found = FileDescriptorSet()
    seen: set[str] = set()

    def add(file: Any) -> None:
        if file.name in seen:
            return
        seen.add(file.name)
        for each in file.dependencies:
            add(each)
        file.CopyToProto(found.file.add())

    add(SceneUpdate.DESCRIPTOR.file)
    return SceneUpdate.DESCRIPTOR.full_name, found.SerializeToString()


def scene(nanoseconds: int, models: dict[str, bytes]) -> bytes:
    """A ``foxglove.SceneUpdate``: a model on each frame, which moves with it.

    Args:
        nanoseconds: When [ns].
        models: Binary glTF by frame.
    """
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    update = SceneUpdate()
    for frame, data in models.items():
        entity = update.entities.add()
        entity.id = entity.frame_id = frame
        entity.frame_locked = True
        entity.timestamp.FromNanoseconds(nanoseconds)
        model = entity.models.add()
        model.media_type, model.data = "model/gltf-binary", data
        model.pose.orientation.w = 1.0
        model.scale.x = model.scale.y = model.scale.z = 1.0
    return bytes(update.SerializeToString())
