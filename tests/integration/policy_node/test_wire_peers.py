"""The node as a process on a real Zenoh network: with another implementation of ROS 2's wire as its peer, and with what goes wrong.

The peer is zenoh-ros2-sdk: its sessions, keys, tokens and attachments are its own; its CDR is rosbags', so the commands are read by
mcap-ros2-support besides. What a peer is sent in `test_what_the_node_says…` are raw bytes.
"""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xxhash
import zenoh
from mcap_ros2._dynamic import generate_dynamic as dynamic
from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

from muster_policy.graph import Node, open_session
from muster_policy.messages import EMPTY, JOINT_STATE, RESET, TWIST, Messages
from muster_policy.wire import parse_token, read_attachment
from tests.conftest import PATIENCE, REPOSITORY, wait_for
from tests.support.policy_node import write_bundle
from tests.unit.policy_node.walker import JOINTS, contract, term

MESSAGES = Messages()
SPEED = term("joint_velocity", 0, 2, **JOINTS)
"""The policy asks for the knee's velocity, so that its target is 0.3 + 0.5 * velocity."""


def free_port() -> int:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        port: int = listening.getsockname()[1]
        return port


class Running:
    """``muster-policy`` as a process that is its own router."""

    def __init__(self, bundle: Path, log: Path, *options: str) -> None:
        self.port, self.log = free_port(), log
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        command = [sys.executable, "-m", "muster_policy.cli", str(bundle), "--listen", self.endpoint, *options]
        env = {**os.environ, "PYTHONPATH": str(REPOSITORY / "policy_node")}
        env.pop("ROS_DOMAIN_ID", None)
        with log.open("w") as out:
            self.process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=env)
        wait_for(lambda: "node /muster_policy" in self.output(), 30, "the node")

    def output(self) -> str:
        return self.log.read_text()

    def end(self) -> int:
        """SIGTERM, as systemd would; the exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(30 * PATIENCE)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("node")
    bundle = write_bundle(folder / "bundle", contract(SPEED), np.array([[1.0], [0.0]]))
    node = Running(bundle, folder / "log", "--timeout", "0.5")
    yield node
    if node.process.poll() is None:
        node.end()


def joint_state(knee: float, names: tuple[str, ...] = ("wheel", "knee")) -> Any:
    numbers = {"position": np.array([0.0, 0.1]), "velocity": np.array([9.0, knee]), "effort": np.zeros(0)}
    return MESSAGES.make(JOINT_STATE, header=MESSAGES.header(0), name=list(names), **numbers)


def definition(kind: str) -> str:
    text: str = MESSAGES._store.generate_msgdef(kind, ros_version=2)[0]
    return text


def test_another_implementation_of_the_wire_drives_the_node_and_hears_it(running: Running) -> None:
    """Joint states from the peer's publisher, commands at the peer's subscriber; each sees the other's tokens."""
    common = {"router_ip": "127.0.0.1", "router_port": running.port, "type_hash": MESSAGES.type_hash(JOINT_STATE)}
    received: list[Any] = []
    kind = {"msg_type": JOINT_STATE, "msg_definition": definition(JOINT_STATE)}
    subscriber = ROS2Subscriber("/joint_commands", callback=received.append, node_name="driver", **kind, **common)
    publisher = ROS2Publisher("/joint_states", node_name="sensors", **kind, **common)
    requested = {
        ("NN", "/muster_policy", "", ""),
        ("MP", "/muster_policy", "/joint_commands", JOINT_STATE),
        ("MS", "/muster_policy", "/joint_states", JOINT_STATE),
        ("MS", "/muster_policy", "/muster_policy/reset", EMPTY),
        ("MS", "/driver", "/joint_commands", JOINT_STATE),
        ("MP", "/sensors", "/joint_states", JOINT_STATE),
    }
    try:
        with open_session(running.endpoint, None) as session:
            tokens: set[str] = set()

            def shown() -> set[tuple[str, str, str, str]]:
                tokens.update(str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/**", timeout=5))
                return {(each.kind, each.node, each.name, each.type) for each in map(parse_token, tokens) if each}

            wait_for(lambda: requested <= shown(), 10, "the tokens of all endpoints")
        shapes = {re.sub(r"/[^/]*/\d+/\d+/", "/", key) for key in tokens if "%joint_" in key}
        ours, theirs = "/MS/%/%/muster_policy/%joint_states/", "/MS/%/%/driver/%joint_commands/"
        tails = [next(key.split(part)[1] for key in shapes if part in key) for part in (ours, theirs)]
        assert tails[0] == tails[1], "type, hash and quality of service are written alike"

        def sent(knee: float) -> bool:
            message = joint_state(knee)
            fields = ("header", "name", "position", "velocity", "effort")
            publisher.publish(**{name: getattr(message, name) for name in fields})
            time.sleep(0.02)
            return bool(received) and received[-1].position.tolist() == [pytest.approx(0.3 + 0.5 * knee)]

        wait_for(lambda: sent(0.4), 20, "a command that follows from the peer's joint state")
        assert received[-1].name == ["knee"] and len(received[-1].velocity) == len(received[-1].effort) == 0
        wait_for(lambda: sent(-0.8), 20, "a command that follows from the next one")
    finally:
        subscriber.close()
        publisher.close()
        ZenohSession.get_instance().close()


def test_another_implementation_of_the_wire_has_the_node_begin_a_fresh_episode(tmp_path: Path) -> None:
    """Type hash, key, token and request are the peer's own."""
    bundle = write_bundle(tmp_path / "bundle", contract(SPEED), np.array([[1.0], [0.0]]))
    running = Running(bundle, tmp_path / "log")
    nothing = "uint8 structure_needs_at_least_one_member"
    empty = {"request_definition": nothing, "response_definition": nothing}
    router = {"router_ip": "127.0.0.1", "router_port": running.port}
    client = ROS2ServiceClient("/muster_policy/reset", RESET, **empty, **router)
    try:
        assert client.type_hash == MESSAGES.type_hash(RESET)
        with open_session(running.endpoint, None) as session:

            def announced() -> list[str]:
                keys = [str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/**", timeout=5)]
                found = [key for kind in ("SS", "SC") for key in keys if f"/{kind}/%/%/" in key]
                return found if len(found) == 2 else []

            ours, theirs = wait_for(announced, 20, "the tokens of the server and of the client")
        assert ours.split("/")[-4:] == theirs.split("/")[-4:], "name, type, hash and quality of service"
        assert client.call(structure_needs_at_least_one_member=0) is not None, "the answer"
        assert client.call(structure_needs_at_least_one_member=0) is not None, "the next one"
        with open_session(running.endpoint, None) as session:
            stranger = session.get(client.keyexpr, target=zenoh.QueryTarget.ALL_COMPLETE, timeout=5)
            assert list(stranger) == [], "a request without rmw_zenoh's attachment"
        assert running.end() == 0 and " 2 resets," in running.output().splitlines()[-1], running.output()
    finally:
        client.close()
        ZenohSession.get_instance().close()
        running.process.kill()


def test_messages_are_readable_by_another_cdr_reader_and_have_rmw_zenohs_attachment(
    running: Running,
) -> None:
    got: list[zenoh.Sample] = []
    with open_session(running.endpoint, None) as session:
        node = Node(session, MESSAGES, name="sensors")
        kind = f"sensor_msgs::msg::dds_::JointState_/{MESSAGES.type_hash(JOINT_STATE)}"
        note = zenoh.handlers.Callback(got.append, indirect=False)
        ear = session.declare_subscriber(f"0/joint_commands/{kind}", note)
        states = node.publisher("joint_states", JOINT_STATE)

        def commanded() -> bool:
            states.publish(joint_state(0.5))
            time.sleep(0.02)
            return len(got) >= 5

        wait_for(commanded, 20, "commands")
        keys = [str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/**", timeout=5)]
        (token,) = (key for key in keys if "/MP/%/%/muster_policy/%joint_commands/" in key)
        ear.undeclare()
        node.close()
    numbers = []
    for sample in got:
        assert sample.attachment is not None
        known = read_attachment(sample.attachment.to_bytes())
        assert known is not None and abs(time.time_ns() - known[1]) < 60e9
        assert known[2] == xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
        numbers.append(known[0])
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "counted one by one"
    read = dynamic("sensor_msgs/JointState", definition(JOINT_STATE))["sensor_msgs/JointState"]
    message = read(got[-1].payload.to_bytes())
    assert list(message.name) == ["knee"] and list(message.position) == [pytest.approx(0.55)]
    assert list(message.velocity) == [] and message.header.stamp.sec > 0


def test_wrong_messages_are_reported_in_a_line_and_the_node_survives_them(running: Running) -> None:
    with open_session(running.endpoint, None) as session:
        node = Node(session, MESSAGES, name="confused")
        wrong = node.publisher("joint_states", TWIST)
        right = node.publisher("joint_states", JOINT_STATE)
        kind = f"sensor_msgs::msg::dds_::JointState_/{MESSAGES.type_hash(JOINT_STATE)}"
        raw = session.declare_publisher(f"0/joint_states/{kind}")

        def reported() -> bool:
            wrong.publish(MESSAGES.twist((0.0,) * 3, (0.0,) * 3))
            raw.put(b"\0\1\0\0nonsense")
            time.sleep(0.05)
            right.publish(joint_state(0.0, ("wheel", "knee_motor")))
            time.sleep(0.05)
            output = running.output()
            return all(
                line in output
                for line in (
                    "/joint_states: message ignored: it is a geometry_msgs/msg/Twist, and the node reads sensor_msgs/msg/JointState",
                    "/joint_states: message ignored: 12 bytes that ",
                    "/joint_states: message ignored: no joint is called knee; did you mean knee_motor?",
                )
            )

        wait_for(reported, 20, "a line for each")
        node.close()
    assert running.process.poll() is None


def test_a_silent_robot_is_reported_a_reset_starts_an_episode_the_end_undeclares_all(
    running: Running,
) -> None:
    wait_for(lambda: "/joint_states is silent for" in running.output(), 20, "the watchdog")
    gone, existing = threading.Event(), threading.Event()
    with open_session(running.endpoint, None) as session:
        node = Node(session, MESSAGES, name="operator")
        output: list[str] = []
        log = lambda data, kind, type_hash: output.append(MESSAGES.decode(data, kind).msg)  # noqa: E731
        node.subscribe("/rosout", "rcl_interfaces/msg/Log", log)
        diagnoses: list[Any] = []
        diagnose = lambda data, kind, type_hash: diagnoses.append(MESSAGES.decode(data, kind))  # noqa: E731
        node.subscribe("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", diagnose)
        reset, states = node.publisher("/muster_policy/reset", EMPTY), node.publisher("joint_states", JOINT_STATE)

        def diagnosed(acting: bool) -> bool:
            if acting:
                states.publish(joint_state(0.1))
            time.sleep(0.02)
            return bool(diagnoses) and (diagnoses[-1].status[0].message == "acting") is acting

        wait_for(lambda: diagnosed(False), 20, "the end of what the tests before sent")
        wait_for(lambda: diagnosed(True), 20, "a diagnosis of the acting node")
        wait_for(lambda: any("all inputs have arrived" in line for line in output), 20, "the line on /rosout")
        reset.publish(MESSAGES.make(EMPTY, structure_needs_at_least_one_member=0))

        def reported(sample: zenoh.Sample) -> None:
            if "/NN/%/%/muster_policy" in str(sample.key_expr):
                (gone if sample.kind == zenoh.SampleKind.DELETE else existing).set()

        ear = zenoh.handlers.Callback(reported, indirect=False)
        session.liveliness().declare_subscriber("@ros2_lv/**", ear, history=True)
        assert existing.wait(30)
        assert running.end() == 0
        assert gone.wait(10)
        assert " 1 resets," in running.output().splitlines()[-1], running.output()
        node.close()


def test_a_taken_port_and_a_missing_router_are_reported_in_one_line(tmp_path: Path) -> None:
    bundle = write_bundle(tmp_path / "bundle", contract(SPEED), np.array([[1.0], [0.0]]))
    command = [sys.executable, "-m", "muster_policy.cli", str(bundle)]
    env = {**os.environ, "PYTHONPATH": str(REPOSITORY / "policy_node")}
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        options = ["--listen", f"tcp/127.0.0.1:{taken.getsockname()[1]}"]
        done = subprocess.run([*command, *options], env=env, capture_output=True, text=True, timeout=60)
    (line,) = done.stderr.strip().splitlines()
    output = f"error: --listen {options[1]}: the port is taken; is a router or another node there?"
    assert done.returncode == 1 and line.startswith(output), done.stderr
    nobody = ["--connect", f"tcp/127.0.0.1:{free_port()}", "--duration", "0.5"]
    done = subprocess.run([*command, *nobody], env=env, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and f"no router answers at {nobody[1]}; it is tried again" in done.stdout, done.stderr
