"""What the policy sees of a robot's messages, computed by hand; what can't be measured or read is reported in one line."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest

from muster_policy.contract import read
from muster_policy.errors import Refused
from muster_policy.inputs import Inputs
from muster_policy.messages import ARRAY, IMAGE, IMU, JOINT_STATE, ODOMETRY, TWIST, Messages
from muster_policy.observations import Observations
from shared_store.contract.policy import Command, Contract, Frame, Group, Image
from tests.support.policy_node import for_node
from tests.support.refusals import refusal
from tests.unit.policy_node.walker import HALF, JOINTS, TRUNK, UNIT, contract, term

MESSAGES = Messages()
NOTHING = np.zeros(9)


def joints(names: tuple[str, ...] = ("wheel", "other", "knee"), **values: Any) -> Any:
    fields = {"position": (2.0, 9.0, 0.7), "velocity": (-1.0, 9.0, 4.0), **values}
    arrays = {name: np.array(each, float) for name, each in fields.items()}
    return MESSAGES.make(JOINT_STATE, header=MESSAGES.header(0), name=list(names), effort=np.zeros(0), **arrays)


def imu(
    turn: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0), angular: tuple[float, ...] = (1.0, 2.0, 3.0), **other: Any
) -> Any:
    fields = {
        "orientation_covariance": NOTHING,
        "angular_velocity_covariance": NOTHING,
        "linear_acceleration": MESSAGES.vector((0.0, 0.0, 9.81)),
        "linear_acceleration_covariance": NOTHING,
        **other,
    }
    turned, speed = MESSAGES.quaternion(turn), MESSAGES.vector(angular)
    return MESSAGES.make(IMU, header=MESSAGES.header(0), orientation=turned, angular_velocity=speed, **fields)


def odometry(linear: tuple[float, ...], angular: tuple[float, ...]) -> Any:
    make = MESSAGES.make
    pose = make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=1.0, y=2.0, z=0.4),
        orientation=MESSAGES.quaternion((0.0, 0.0, HALF, HALF)),
    )
    return make(
        ODOMETRY,
        header=MESSAGES.header(0),
        child_frame_id="trunk",
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
        twist=make(
            "geometry_msgs/msg/TwistWithCovariance", twist=MESSAGES.twist(linear, angular), covariance=np.zeros(36)
        ),
    )


class Received:
    """Observations of a contract, and messages for them."""

    def __init__(self, supplied: Contract, **names: str) -> None:
        self.observations = Observations(for_node(supplied))
        self.inputs = Inputs(self.observations, MESSAGES, names)

    def hear(self, topic: str, message: Any, kind: str, data: bytes | None = None) -> list[str]:
        """Take in a message; what the node says of it."""
        (existing,) = (each for each in self.inputs.all if each.topic == topic)
        bytes_ = MESSAGES.encode(message, kind) if data is None else data
        self.inputs.hear(existing, f"/{topic}")(bytes_, kind, MESSAGES.type_hash(kind))
        self.inputs.update({topic: f"/{topic}"})
        return self.inputs.complaints()

    def all(self) -> None:
        assert self.hear("joint_states", joints(), JOINT_STATE) == []
        assert self.hear("imu", imu((HALF, 0.0, 0.0, HALF)), IMU) == []
        assert self.hear("odom", odometry((1.0, 0.0, 0.0), (0.0, 0.0, 2.0)), ODOMETRY) == []
        assert self.hear("cmd_vel", MESSAGES.twist((3.0, 0.25, 7.0), (8.0, 9.0, -6.0)), TWIST) == []

    def seen(self) -> list[float]:
        found: list[float] = self.observations.build(self.inputs.snapshot(0.0))["obs"][0].tolist()
        return found


def test_each_term_follows_the_contract_from_the_messages() -> None:
    received = Received(contract())
    received.all()
    received.observations.acted(np.array([1.5], np.float32))
    assert received.seen() == pytest.approx(
        [
            # 2 * clip(0.7 - 0.3) and clip(2): joints by name, whatever their order
            *(0.8, 0.5),
            # two steps of velocities, before an episode's first step its first values
            *(4.0, -1.0, 4.0, -1.0),
            # The unit lies on its side, rolled by 90 degrees about its own x: down is its -y. Its y is the trunk's -x, so down is +x.
            *(1.0, 0.0, 0.0),
            *(1.0, 2.0, 3.0),
            # trunk 1 m/s along x; 2 rad/s about z move the unit, 0.1 m ahead, by 0.2 m/s along y, which is its x; trunk's x is its -y
            *(0.2, -1.0, 0.0),
            # within what was commanded in training: forward up to 2, turning without a limit
            *(2.0, 0.25, -6.0),
            1.5,
        ],
        abs=1e-6,
    )


def test_history_shifts_and_a_reset_forgets_it_and_the_last_action() -> None:
    received = Received(contract())
    received.all()
    received.observations.acted(np.array([1.5], np.float32))
    received.seen()
    received.hear("joint_states", joints(velocity=(0.0, 0.0, 5.0)), JOINT_STATE)
    assert received.seen()[2:6] == [4.0, -1.0, 5.0, 0.0], "the oldest first"
    received.observations.reset()
    seen = received.seen()
    assert seen[2:6] == [5.0, 0.0, 5.0, 0.0] and seen[-1] == 0.0


def test_a_commanded_velocity_that_is_too_old_is_0() -> None:
    received = Received(contract())
    received.all()
    (command,) = (each for each in received.inputs.all if each.topic == "cmd_vel")
    snapshot = received.inputs.snapshot(command.arrived + 0.6)
    assert snapshot.commands["velocity"].tolist() == [0.0, 0.0, 0.0]
    assert command.is_silent(command.arrived + 0.6) and not command.is_silent(command.arrived + 0.4)


def test_a_policy_never_goes_faster_than_commanded() -> None:
    received = Received(contract())
    received.all()
    (command,) = (each for each in received.inputs.all if each.topic == "cmd_vel")
    assert command.command is not None
    now, ranges = command.arrived, command.command.ranges[1:]
    for ends, value, slow in (
        *(((0.5, 1.0), 0.0, True), ((0.5, 1.0), -0.7, True), ((0.5, 1.0), 0.6, False), ((0.5, 1.0), 3.0, False)),
        *(((-1.0, -0.5), -0.2, True), ((-1.0, 1.0), 0.0, False)),
    ):
        command.command = dataclasses.replace(command.command, ranges=(ends, *ranges))
        command.value = np.array([value, 0.0, 0.0])
        assert command.is_too_slow(now) == slow, (ends, value)
    command.command = dataclasses.replace(command.command, ranges=((0.5, 1.0), *ranges))
    command.value = np.array([0.7, 0.0, 0.0])
    assert not command.is_too_slow(now + 0.4) and command.is_too_slow(now + 0.6), "silence is 0"


def test_other_commands_are_arrays_that_do_not_grow_old() -> None:
    reach = Command("reach", ("x", "y"), ("m", "m"), ((0.0, 1.0), None), (5.0, 5.0), "pose_command", True)
    reported = term("command_number", 0, 2, kind="command", command="reach", element="index", elements=("0", "1"))
    received = Received(contract(reported, commands=(reach,)))
    received.hear("joint_states", joints(("knee",), position=(0.0,), velocity=(0.0,)), JOINT_STATE)
    line = "/commands/reach: message ignored: 3 numbers, the command reach has x, y"
    assert received.hear("commands/reach", MESSAGES.array((1.0, 2.0, 3.0)), ARRAY) == [line]
    received.hear("commands/reach", MESSAGES.array((1.5, 2.0)), ARRAY)
    assert received.seen() == [1.0, 2.0]
    assert received.inputs.snapshot(1e9).commands["reach"].tolist() == [1.0, 2.0]


def test_images_are_stacked_with_the_present_one_first() -> None:
    group = Group("policy", "image", (6, 2, 2), "uint8", image=Image(("red", "green", "blue"), 2, {}))
    received = Received(contract(groups=(group,)))
    received.hear("joint_states", joints(("knee",), position=(0.0,), velocity=(0.0,)), JOINT_STATE)

    def picture(first: int, **changes: Any) -> Any:
        data = np.arange(first, first + 14, dtype=np.uint8)  # rows of 6 bytes and one of padding
        fields = {"height": 2, "width": 2, "encoding": "bgr8", "is_bigendian": 0, "step": 7, "data": data, **changes}
        return MESSAGES.make(IMAGE, header=MESSAGES.header(0), **fields)

    assert received.hear("image_raw", picture(0, encoding="mono8"), IMAGE) == [
        "/image_raw: message ignored: an image of encoding mono8; the policy takes rgb8 or bgr8"
    ]
    assert received.hear("image_raw", picture(0, width=3), IMAGE) == [
        "/image_raw: message ignored: an image of 3 x 2, the policy takes 2 x 2"
    ]
    received.hear("image_raw", picture(0), IMAGE)
    red, green, blue = [[2, 5], [9, 12]], [[1, 4], [8, 11]], [[0, 3], [7, 10]]
    assert received.observations.build(received.inputs.snapshot(0.0))["image"].tolist() == [[red, green, blue] * 2]
    received.hear("image_raw", picture(100), IMAGE)
    seen = received.observations.build(received.inputs.snapshot(0.0))["image"][0]
    assert seen[0].tolist() == [[102, 105], [109, 112]] and seen[3].tolist() == red and seen.dtype == np.uint8


MISSING = np.array([-1.0] + [0.0] * 8)
"""Covariance of what is not measured."""
UNUSABLE = {
    "no joint is called knee; did you mean Knee? (--joints FILE gives the robot's names)": joints(("wheel", "Knee")),
    "no joint is called knee; there are: wheel (--joints FILE gives the robot's names)": joints(("wheel",)),
    "0 velocities of 3 joints; the policy needs each joint's": joints(velocity=()),
    "not finite: its positions": joints(position=(0.0, 0.0, np.nan)),
    "not finite: its velocities": joints(velocity=(np.inf, 0.0, 0.0)),
    "a joint is named twice": joints(("knee", "wheel", "knee")),
    "it has no orientation (orientation_covariance[0] is -1)": imu(orientation_covariance=MISSING),
    "its orientation is not a rotation: a quaternion of length 0": imu((0.0, 0.0, 0.0, 0.0)),
    "not finite: its angular velocity": imu(angular=(0.0, np.nan, 0.0)),
    "it has no angular velocity (angular_velocity_covariance[0] is -1)": imu(angular_velocity_covariance=MISSING),
}


@pytest.mark.parametrize("output", UNUSABLE)
def test_a_message_that_can_t_be_used_is_ignored_with_one_line(output: str) -> None:
    message, received = UNUSABLE[output], Received(contract())
    topic, kind = ("imu", IMU) if hasattr(message, "orientation") else ("joint_states", JOINT_STATE)
    (line,) = received.hear(topic, message, kind)
    assert line.startswith(f"/{topic}: message ignored: {output}")
    assert received.hear(topic, message, kind) == [], "once"
    assert received.inputs.ignored[f"/{topic}"] == 2 and len(received.inputs.missing()) == 4


def test_a_good_message_after_a_bad_one_counts_and_a_bad_one_does_not_make_the_last_good_one_younger() -> None:
    received = Received(contract())
    received.hear("joint_states", joints(), JOINT_STATE)
    existing = received.inputs.all[0]
    arrived, value = existing.arrived, existing.value
    received.hear("joint_states", joints(position=(0.0, 0.0, np.nan)), JOINT_STATE)
    assert existing.arrived == arrived and existing.value is value
    received.hear("joint_states", joints(), JOINT_STATE)
    assert existing.arrived > arrived


@pytest.mark.parametrize(
    ("kind", "data", "output"),
    [
        (TWIST, None, "/imu: message ignored: it is a geometry_msgs/msg/Twist, and the node reads sensor_msgs/msg/Imu"),
        (IMU, b"\0\1\0\0abc", "/imu: message ignored: 7 bytes that aren't a sensor_msgs/msg/Imu"),
        (IMU, b"", "/imu: message ignored: 0 bytes that aren't a sensor_msgs/msg/Imu"),
    ],
)
def test_a_message_of_a_wrong_type_or_of_wrong_bytes_is_ignored_with_one_line(
    kind: str, data: bytes | None, output: str
) -> None:
    received = Received(contract())
    (line,) = received.hear("imu", MESSAGES.twist((0.0,) * 3, (0.0,) * 3), kind, data)
    assert line.startswith(output) and "\n" not in line
    (existing,) = (each for each in received.inputs.all if each.topic == "imu")
    received.inputs.hear(existing, "/imu")(b"", IMU, "RIHS01_0123")
    other = received.inputs.complaints()[-1]
    assert "/imu: message ignored: sensor_msgs/msg/Imu of another definition (RIHS01_0123" in other
    assert other.endswith("give --distro as the robot has it")


def test_an_imu_without_orientation_suffices_for_a_policy_that_reads_none() -> None:
    received = Received(contract(term("imu_angular_velocity", 0, 3, frame=UNIT)))
    without = imu((0.0, 0.0, 0.0, 0.0), orientation_covariance=MISSING)
    assert received.hear("imu", without, IMU) == []


LEG = Frame("foot", "foot", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), False)


UNAVAILABLE = {
    "attitude: attitude is not a function of Muster's library": (term("attitude", 0, 4, library=False),),
    "scanned_height: scanned_height (of HeightScan, bodies trunk) is in no message that the node reads": (
        term("scanned_height", 0, 2, sensors={"scan": "HeightScan, bodies trunk"}),
    ),
    "joint_effort: joint_effort of joints is in no message that the node reads": (
        term("joint_effort", 0, 2, **JOINTS),
    ),
    "joint_offset: the contract has no default position of wheel": (term("joint_offset", 0, 2, **JOINTS),),
    "root_height: the contract does not say where root_height is measured": (term("root_height", 0, 1),),
    "imu_linear_velocity: imu_linear_velocity is measured on foot": (term("imu_linear_velocity", 0, 3, frame=LEG),),
    "projected_gravity: projected_gravity is of the root, and the inertial measurement unit is on foot": (
        term("projected_gravity", 0, 3, frame=TRUNK),
        term("imu_angular_velocity", 3, 3, frame=LEG),
    ),
    "it has several inertial measurement units (imu on trunk, foot on foot), the node reads one": (
        term("imu_acceleration", 0, 3, frame=UNIT),
        term("imu_angular_velocity", 3, 3, frame=LEG),
    ),
    "command_speed: command_speed of the command": (term("command_speed", 0, 1, kind="command", command="velocity"),),
    "a: x is not a function of Muster's library; b: y is not a function of Muster's library": (
        term("a", 0, 1, quantity="x", library=False),
        term("b", 1, 1, quantity="y", library=False),
    ),
}


@pytest.mark.parametrize("output", UNAVAILABLE)
def test_a_policy_that_needs_an_unavailable_quantity_is_refused_in_one_line(output: str) -> None:
    terms = UNAVAILABLE[output]
    line = refusal(Observations, for_node(contract(*terms)), error=Refused)
    assert line.startswith(f"task Walker can't run on a robot: {output}") and "\n" not in line


def test_groups_that_the_node_can_t_read_are_refused() -> None:
    depth = Group("front", "front", (1, 2, 2), "uint8", image=Image(("depth",), 1, {}))
    bare = Group("policy", "obs", (3,), "float32")
    with pytest.raises(
        Refused, match="the images of front have the channels depth, the node reads red, green, blue or grey"
    ):
        Observations(for_node(contract(groups=(depth,))))
    with pytest.raises(Refused, match="the contract does not say what the numbers of policy are"):
        Observations(for_node(contract(groups=(bare,))))


def test_a_joint_of_another_name_on_the_robot_is_found_by_it() -> None:
    received = Received(contract(), knee="KneeMotor")
    assert received.hear("joint_states", joints(("wheel", "other", "KneeMotor")), JOINT_STATE) == []
    positions, _ = received.inputs.all[0].value
    assert dict(zip(received.observations.joints, positions, strict=True)) == {"knee": 0.7, "wheel": 2.0}
    (line,) = received.hear("joint_states", joints(("wheel", "other", "knee")), JOINT_STATE)
    assert "no joint is called KneeMotor (knee of the policy)" in line


def test_a_contract_of_format_1_is_refused_with_a_remedy() -> None:
    document = contract(dataclasses.replace(term("joint_velocity", 0, 2, **JOINTS), library=False)).document()
    document["format"] = 1
    for each in document["groups"][0]["terms"]:
        del each["library"], each["frame"]
    for each in document["actions"]:
        del each["range"]
    for each in document["commands"]:
        del each["quantity"], each["library"]
    with pytest.raises(
        Refused,
        match="joint_velocity: the contract is of format 1, which does not say what it is; export the policy again",
    ):
        Observations(read(json.dumps(document).encode(), "contract.json"))
