"""rmw_zenoh's wire, byte by byte and by hand."""

from __future__ import annotations

import pytest
import xxhash

from muster_policy import wire
from muster_policy.messages import DISTRIBUTIONS, EMPTY, IMU, JOINT_STATE, RESET, TWIST, Messages

HASH = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"


def test_a_key_is_domain_topic_type_and_hash() -> None:
    key = wire.topic_key(7, "/robot/joint_states", JOINT_STATE, HASH)
    assert key == f"7/robot/joint_states/sensor_msgs::msg::dds_::JointState_/{HASH}"
    assert wire.topic_key(0, "/imu", "*", "*") == "0/imu/*/*"


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (wire.Qos(), "::,10:,:,:,,"),
        (wire.Qos(depth=1, transient_local=True), ":1:,1:,:,:,,"),
    ],
)
def test_a_quality_of_service_leaves_out_defaults(qos: wire.Qos, text: str) -> None:
    assert str(qos) == text


def test_tokens_of_nodes_and_endpoints_mangle_slashes() -> None:
    assert wire.node_token(0, "ab12", 0, "/", "driver") == "@ros2_lv/0/ab12/0/0/NN/%/%/driver"
    token = wire.endpoint_token(
        3, "ab12", (0, 4), "MP", ("/left/arm", "driver"), "/left/arm/cmd", (TWIST, HASH), wire.Qos()
    )
    assert token == (
        f"@ros2_lv/3/ab12/0/4/MP/%/%left%arm/driver/%left%arm%cmd/geometry_msgs::msg::dds_::Twist_/{HASH}/::,10:,:,:,,"
    )
    assert wire.parse_token(token) == wire.Endpoint("MP", "/left/arm/driver", "/left/arm/cmd", TWIST, HASH)
    assert (
        wire.mangled("") == "%"
        and wire.dds_type(IMU) == "sensor_msgs::msg::dds_::Imu_"
        and wire.ros_type(wire.dds_type(IMU)) == IMU
    )


def test_a_token_of_a_newer_ros_with_one_more_field_is_read() -> None:
    """Lyrical's has the backends of buffers behind the quality of service."""
    token = f"@ros2_lv/0/ab12/0/4/MS/%/%/viewer/%imu/{wire.dds_type(IMU)}/{HASH}/::,10:,:,:,,/cpu;cuda"
    assert wire.parse_token(token) == wire.Endpoint("MS", "/viewer", "/imu", IMU, HASH)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "@ros2_lv/0/ab12",
        "@other/0/ab12/0/0/NN/%/%/driver",
        "@ros2_lv/0/ab12/0/0/XX/%/%/driver",
        f"@ros2_lv/0/ab12/0/4/MP/%/%/driver/%imu/{wire.dds_type(IMU)}",
        "@ros2_lv/0/ab12/0/4/NN/%//",
    ],
)
def test_a_malformed_token_gives_no_endpoint(key: str) -> None:
    assert wire.parse_token(key) is None


def test_an_attachment_has_33_bytes_and_a_gid_the_halves_of_the_token_s_hash() -> None:
    gid = bytes(range(16))
    data = wire.attachment(1, 0x0102030405060708, gid)
    assert data == b"\x01" + bytes(7) + bytes([8, 7, 6, 5, 4, 3, 2, 1]) + b"\x10" + gid and len(data) == 33
    assert wire.read_attachment(data) == (1, 0x0102030405060708, gid)
    assert wire.read_attachment(data[:-1]) is None and wire.read_attachment(data[:16] + b"\x11" + gid) is None
    token = wire.node_token(0, "ab12", 0, "/", "driver")
    number = xxhash.xxh3_128_intdigest(token.encode())
    low, high = number & (2**64 - 1), number >> 64
    assert wire.gid_of(token) == low.to_bytes(8, "little") + high.to_bytes(8, "little")


def test_type_hashes_are_those_that_ros_publishes_and_humble_has_none() -> None:
    messages = Messages("jazzy")
    assert messages.type_hash(JOINT_STATE) == HASH
    published = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert messages.type_hash("std_msgs/msg/String") == published
    assert Messages("humble").type_hash(JOINT_STATE) == Messages("humble").type_hash(RESET) == wire.NO_HASH
    hashes = {Messages(name).type_hash(JOINT_STATE) for name in DISTRIBUTIONS}
    assert hashes == {HASH, wire.NO_HASH}, "the type has not changed since Iron"
    empty = messages.make(EMPTY, structure_needs_at_least_one_member=0)
    assert messages.encode(empty, EMPTY) == bytes([0, 1, 0, 0, 0])
