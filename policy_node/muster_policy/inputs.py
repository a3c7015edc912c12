"""The node's inputs: the newest message of each topic, decoded and checked, with its age."""

from __future__ import annotations

import re
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from muster_policy.contract import Command, Group
from muster_policy.errors import Refused, nearest
from muster_policy.messages import ARRAY, IMAGE, IMU, JOINT_STATE, ODOMETRY, TWIST, Messages
from muster_policy.observations import IMU as IMU_TOPIC
from muster_policy.observations import (
    JOINTS,
    Imu,
    Observations,
    Odometry,
    Snapshot,
    command_topic,
    image_topic,
    is_twist,
    matrix,
)
from muster_policy.observations import ODOMETRY as ODOMETRY_TOPIC

COMMAND_TIMEOUT = 0.5
"""Age from which a commanded velocity no longer counts: the policy is then commanded to stand [s]."""
_DIFFERENT = 32
"""Limit of different complaints; each is reported once."""


@dataclass
class Input:
    """A topic to which the node subscribes.

    Attributes:
        topic: Its name in the node's namespace, before remapping.
        kind: ROS type of its messages.
        read: Returns the value of a message; raises Refused for an unusable one.
        command: Its command; None for measurements.
        value: Value of the last good message; None before the first.
        arrived: Arrival of that message [s, monotonic].
        waiting: The newest message that is not decoded yet, and its arrival.
        count: Number of good messages so far.
    """

    topic: str
    kind: str
    read: Callable[[Any], Any]
    command: Command | None = None
    value: Any = None
    arrived: float = -float("inf")
    waiting: tuple[bytes, float] | None = None
    count: int = 0

    def is_silent(self, now: float) -> bool:
        """Whether it is a commanded velocity that is too old to count."""
        return self.command is not None and is_twist(self.command) and now - self.arrived > COMMAND_TIMEOUT

    def is_too_slow(self, now: float) -> bool:
        """Whether it is a commanded velocity between 0 and the training's range: the policy would go faster than commanded."""
        if self.command is None or not is_twist(self.command):
            return False
        pairs = zip(self._commanded(now), self.command.ranges, strict=True)
        return any(pair is not None and (0.0 < pair[0] > value or 0.0 > pair[1] < value) for value, pair in pairs)

    def limited(self, now: float) -> np.ndarray:
        """The numbers of a command, clipped to its range in training."""
        assert self.command is not None
        ends = [(-np.inf, np.inf) if pair is None else pair for pair in self.command.ranges]
        within: np.ndarray = np.clip(self._commanded(now), *np.array(ends).T)
        return within

    def _commanded(self, now: float) -> np.ndarray:
        """The numbers of a command; a commanded velocity that is too old is 0."""
        assert self.command is not None
        value: np.ndarray = np.zeros(len(self.command.names)) if self.is_silent(now) else self.value
        return value


class Inputs:
    """All inputs of a policy.

    Args:
        observations: The policy's needs.
        messages: Types of the distribution.
        names: Name of a joint on the robot by its name in the contract, if it differs.
    """

    def __init__(self, observations: Observations, messages: Messages, names: Mapping[str, str] | None = None) -> None:
        self._observations, self._messages = observations, messages
        renamed = names or {}
        self._joints = [renamed.get(joint, joint) for joint in observations.joints]
        self._columns: dict[tuple[str, ...], np.ndarray] = {}
        self.all = [Input(JOINTS, JOINT_STATE, self._joint_state)]
        if IMU_TOPIC in observations.needs:
            self.all.append(Input(IMU_TOPIC, IMU, _imu_for(observations.quantities)))
        if ODOMETRY_TOPIC in observations.needs:
            self.all.append(Input(ODOMETRY_TOPIC, ODOMETRY, _odometry))
        for command in observations.commands.values():
            kind, read = (TWIST, _twist) if is_twist(command) else (ARRAY, _numbers_of(command))
            self.all.append(Input(command_topic(command), kind, read, command))
        for group in observations.images.values():
            self.all.append(Input(image_topic(group.name), IMAGE, _image_of(group)))
        self.news = threading.Condition()
        """Notified when a joint state arrives."""
        self.ignored: Counter[str] = Counter()
        """Count of unusable messages, by topic."""
        self._complaints: deque[str] = deque(maxlen=100)
        self._reported: set[str] = set()

    def hear(self, each: Input, topic: str) -> Callable[[bytes, str, str], None]:
        """The callback for each message of an input, on any thread.

        Args:
            each: The input.
            topic: Its full name, for complaints.
        """
        expected = self._messages.type_hash(each.kind)

        def received(data: bytes, kind: str, type_hash: str) -> None:
            if kind != each.kind:
                self._complain(topic, f"it is a {kind}, and the node reads {each.kind}")
            elif type_hash != expected:
                what = f"{kind} of another definition ({type_hash[:20]}…, here {expected[:20]}…)"
                self._complain(topic, f"{what}; give --distro as the robot has it")
            else:
                with self.news:
                    each.waiting = data, time.monotonic()
                    if each is self.all[0]:
                        self.news.notify_all()

        return received

    def update(self, topics: Mapping[str, str] | None = None) -> None:
        """Decode the messages since the last call; unusable ones are counted, and the previous value stays.

        Args:
            topics: Full names, for complaints.
        """
        for each in self.all:
            with self.news:  # a message that arrives meanwhile must not be lost: a command may come only once
                waiting, each.waiting = each.waiting, None
            if waiting is None:
                continue
            data, arrived = waiting
            try:
                each.value = each.read(self._messages.decode(data, each.kind))
                each.arrived, each.count = arrived, each.count + 1
            except Refused as problem:
                self._complain((topics or {}).get(each.topic, each.topic), str(problem))

    def complaints(self) -> list[str]:
        """Unusable messages since the last call, one line for each different problem."""
        return [self._complaints.popleft() for _ in range(len(self._complaints))]

    def missing(self) -> list[Input]:
        """Inputs without a good message yet."""
        return [each for each in self.all if each.value is None]

    def stale(self, now: float, timeout: float) -> list[tuple[Input, float]]:
        """Measurements that are too old, with their age [s]; commands do not count."""
        ages = [(each, now - each.arrived) for each in self.all if each.command is None]
        return [(each, age) for each, age in ages if age > timeout]

    def snapshot(self, now: float) -> Snapshot:
        """The current inputs; none may be missing. A commanded velocity that is too old is 0."""
        values = {each.topic: each.value for each in self.all}
        commands = {each.command.name: each.limited(now) for each in self.all if each.command is not None}
        position, velocity = values[JOINTS]
        images = {name: values[image_topic(name)] for name in self._observations.images}
        return Snapshot(position, velocity, values.get(IMU_TOPIC), values.get(ODOMETRY_TOPIC), commands, images)

    def _joint_state(self, message: Any) -> tuple[np.ndarray, np.ndarray]:
        names = tuple(message.name)
        columns = self._columns.get(names)
        if columns is None:
            columns = self._columns[names] = self._find(names)
        found = []
        for what, values in (("positions", message.position), ("velocities", message.velocity)):
            if len(values) != len(names):
                raise Refused(f"{len(values)} {what} of {len(names)} joints; the policy needs each joint's")
            found.append(_finite(values[columns], what))
        return found[0], found[1]

    def _find(self, names: Sequence[str]) -> np.ndarray:
        for joint, robot_name in zip(self._observations.joints, self._joints, strict=True):
            if robot_name not in names:
                alias = "" if joint == robot_name else f" ({joint} of the policy)"
                raise Refused(
                    f"no joint is called {robot_name}{alias}; {nearest(robot_name, names, 'there are')} "
                    "(--joints FILE gives the robot's names)"
                )
        if len(set(names)) != len(names):
            raise Refused("a joint is named twice")
        return np.array([names.index(name) for name in self._joints])

    def _complain(self, topic: str, problem: str) -> None:
        self.ignored[topic] += 1
        line = f"{topic}: message ignored: {problem}"
        kind = re.sub(r"[0-9.]+", "#", line)  # the same problem with other numbers is reported once
        if kind not in self._reported and len(self._reported) < _DIFFERENT:
            self._reported.add(kind)
            self._complaints.append(line)


def _finite(values: Any, what: str) -> np.ndarray:
    found = np.asarray(values, dtype=np.float64)
    if not np.isfinite(found).all():
        raise Refused(f"not finite: its {what}")
    return found


def _xyz(vector: Any, what: str) -> np.ndarray:
    return _finite((vector.x, vector.y, vector.z), what)


def _rotation(turn: Any) -> np.ndarray:
    found = _finite((turn.x, turn.y, turn.z, turn.w), "orientation")
    length = float(np.sqrt((found * found).sum()))
    if abs(length - 1.0) > 0.01:
        raise Refused(f"its orientation is not a rotation: a quaternion of length {length:.3g}")
    return found / length


def _imu_for(quantities: set[str]) -> Callable[[Any], Imu]:
    """A reader of the fields that these quantities need; by ROS's convention, a covariance that begins with -1 means "not measured"."""

    def needs(message: Any, field: str, *known: str, hint: str = "") -> bool:
        missing = quantities.intersection(known) and getattr(message, f"{field}_covariance")[0] == -1.0
        if missing:
            what = {"linear_acceleration": "acceleration"}.get(field, field.replace("_", " "))
            raise Refused(f"it has no {what} ({field}_covariance[0] is -1){hint}")
        return bool(quantities.intersection(known))

    def read(message: Any) -> Imu:
        turn, rate, force = np.eye(3), np.zeros(3), np.zeros(3)
        turned = "projected_gravity", "root_uprightness", "imu_projected_gravity"
        if needs(message, "orientation", *turned, hint="; run a filter that estimates it"):
            turn = matrix(_rotation(message.orientation))
        if needs(message, "linear_acceleration", "imu_acceleration"):
            force = _xyz(message.linear_acceleration, "linear acceleration")
        if needs(message, "angular_velocity", "imu_angular_velocity", "root_angular_velocity"):
            rate = _xyz(message.angular_velocity, "angular velocity")
        return Imu(turn, rate, force)

    return read


def _odometry(message: Any) -> Odometry:
    pose, twist = message.pose.pose, message.twist.twist
    return Odometry(
        _xyz(pose.position, "position"),
        _rotation(pose.orientation),
        _xyz(twist.linear, "linear velocity"),
        _xyz(twist.angular, "angular velocity"),
    )


def _twist(message: Any) -> np.ndarray:
    return _finite((message.linear.x, message.linear.y, message.angular.z), "velocities")


def _numbers_of(command: Command) -> Callable[[Any], np.ndarray]:
    def read(message: Any) -> np.ndarray:
        if len(message.data) != len(command.names):
            raise Refused(f"{len(message.data)} numbers, the command {command.name} has {', '.join(command.names)}")
        return _finite(message.data, "numbers")

    return read


def _image_of(group: Group) -> Callable[[Any], np.ndarray]:
    assert group.image is not None
    _, height, width = group.shape
    count = len(group.image.channels)
    orders = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0)} if count == 3 else {"mono8": (0,)}

    def read(message: Any) -> np.ndarray:
        if message.encoding not in orders:
            raise Refused(f"an image of encoding {message.encoding}; the policy takes {' or '.join(orders)}")
        if (message.height, message.width) != (height, width):
            raise Refused(f"an image of {message.width} x {message.height}, the policy takes {width} x {height}")
        if message.step < width * count or len(message.data) != message.step * height:
            raise Refused(f"an image of {len(message.data)} bytes in rows of {message.step}")
        rows = np.asarray(message.data, np.uint8).reshape(height, message.step)[:, : width * count]
        pixels = rows.reshape(height, width, count)[:, :, orders[message.encoding]]
        return np.ascontiguousarray(pixels.transpose(2, 0, 1))

    return read
