"""ROS 2's message types of one distribution: their CDR encoding and their hashes."""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from muster_policy.errors import Refused
from muster_policy.wire import NO_HASH

DISTRIBUTIONS = ("humble", "jazzy", "kilted", "lyrical")
JOINT_STATE = "sensor_msgs/msg/JointState"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST = "geometry_msgs/msg/Twist"
IMAGE = "sensor_msgs/msg/Image"
ARRAY = "std_msgs/msg/Float64MultiArray"
EMPTY = "std_msgs/msg/Empty"
RESET = "std_srvs/srv/Empty"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
LOG = "rcl_interfaces/msg/Log"
NOTHING = b"\0\1\0\0\0"
"""CDR of a message without fields: ROS 2 writes one byte."""
_SERVICES = {RESET: "RIHS01_5888399dedec5ccc85ea6451949fd2c9f97bfdf963f9a588821639fcd31b5d19"}
"""Type hashes of services, as ROS 2 publishes them since Jazzy: rosbags computes those of messages."""


class Messages:
    """The types of a distribution.

    Args:
        distribution: One of :data:`DISTRIBUTIONS`.
    """

    def __init__(self, distribution: str = "jazzy") -> None:
        self.distribution = distribution
        self._store = get_typestore(Stores[f"ROS2_{distribution.upper()}"])
        self._hashes: dict[str, str] = {}

    def type_hash(self, name: str) -> str:
        """``RIHS01_…`` of a type of messages, or of one of the node's services; for Humble, the placeholder."""
        if self.distribution == "humble":
            return NO_HASH
        if name not in self._hashes:
            self._hashes[name] = _SERVICES.get(name) or str(self._store.hash_rihs01(name))
        return self._hashes[name]

    def make(self, name: str, /, **fields: Any) -> Any:
        """A message, or a part of one."""
        return self._store.types[name](**fields)

    def encode(self, message: Any, name: str) -> bytes:
        """A message as CDR, little endian, with its header of 4 bytes."""
        return bytes(self._store.serialize_cdr(message, name))

    def decode(self, data: bytes, name: str) -> Any:
        """A message from CDR. Raises Refused if the bytes are not a message of that type."""
        try:
            return self._store.deserialize_cdr(data, name)
        except Exception as error:  # malformed bytes can raise any error in the reader
            raise Refused(f"{len(data)} bytes that aren't a {name} ({type(error).__name__})") from None

    def stamp(self, nanoseconds: int) -> Any:
        """A ``builtin_interfaces/Time``."""
        seconds, rest = divmod(nanoseconds, 10**9)
        return self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)

    def header(self, nanoseconds: int, frame: str = "") -> Any:
        """A ``std_msgs/Header``."""
        return self.make("std_msgs/msg/Header", stamp=self.stamp(nanoseconds), frame_id=frame)

    def vector(self, values: Any) -> Any:
        """A ``geometry_msgs/Vector3``."""
        x, y, z = (float(each) for each in values)
        return self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def quaternion(self, values: Any) -> Any:
        """A ``geometry_msgs/Quaternion`` of x, y, z, w."""
        x, y, z, w = (float(each) for each in values)
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def twist(self, linear: Any, angular: Any) -> Any:
        """A ``geometry_msgs/Twist`` of two vectors [m/s], [rad/s]."""
        return self.make(TWIST, linear=self.vector(linear), angular=self.vector(angular))

    def array(self, values: Any) -> Any:
        """A ``std_msgs/Float64MultiArray`` of one dimension."""
        layout = self.make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        return self.make(ARRAY, layout=layout, data=np.asarray(values, dtype=np.float64))
