"""The CLI of the policy node: ``muster-policy BUNDLE`` runs a policy bundle on a robot."""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from muster_policy import __version__
from muster_policy.bundle import Bundle, open_bundle
from muster_policy.errors import Refused, nearest
from muster_policy.messages import DISTRIBUTIONS
from muster_policy.node import PolicyNode, Settings
from muster_policy.observations import IMU
from muster_policy.policy import Policy

EXAMPLES = """\
examples:
  muster-policy go1-policy --check                     verify the bundle and its actions, without a connection
  muster-policy go1-policy                             with a router (rmw_zenohd) on this host
  muster-policy go1-policy --listen tcp/0.0.0.0:7447   be the router; the robot's nodes connect to this host
  muster-policy go1-policy --remap imu:=/imu/data --joints names.txt --controller forward_position_controller

It reads joint_states (sensor_msgs/JointState) and, where the policy needs them, imu (sensor_msgs/Imu), odom
(nav_msgs/Odometry), cmd_vel (geometry_msgs/Twist), commands/NAME (std_msgs/Float64MultiArray) and images
(sensor_msgs/Image). It publishes joint_commands (sensor_msgs/JointState), /rosout and /diagnostics, and begins a fresh
episode when std_msgs/Empty arrives on ~/reset. docs/policy-node.md says more.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit status: 0 after a clean end, 1 for a mismatch, 2 for wrong use."""
    settings = parser().parse_args(arguments, Settings())
    try:
        bundle = open_bundle(settings.bundle)
        policy = Policy(bundle)
        greatest = policy.self_test(bundle.parity)
        _say(f"{bundle.contract.task} of {bundle.origin}: self-test passed, actions differ by {greatest:.1e} at most")
        _complete(settings, bundle)
        node = PolicyNode(bundle, settings, policy, _say)
        _introduce(node, bundle)
        if settings.check:
            return 0
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, lambda *_: node.stopping.set())
        node.run()
    except Refused as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return 1
    return 0


class _Parser(argparse.ArgumentParser):
    """A parser that refuses in one line, with the nearest option."""

    def error(self, message: str) -> NoReturn:
        words = message.removeprefix("argument ")
        if unknown := re.match(r"unrecognized arguments: (\S+)", message):
            word = unknown[1]
            words = f"{word}: more arguments than the command takes"
            if word.startswith("-"):
                near = nearest(word, [name for name in self._option_string_actions if name.startswith("--")])
                words = f"{word}: there is no such option" + (f"; {near}" if near.startswith("did") else "")
        elif missing := re.match(r"the following arguments are required: (.*)", message):
            words = f"{missing[1].upper()} is missing"
        self.exit(2, f"{self.prog}: {words}{'' if words.endswith('?') else ';'} see: {self.prog} --help\n")


def parser() -> argparse.ArgumentParser:
    """Of the command line."""
    found = _Parser(
        prog="muster-policy",
        description="Run a policy that `muster export` wrote on a robot, as a ROS 2 node on rmw_zenoh's wire.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = found.add_argument
    add("bundle", type=Path, help="directory of the bundle")
    add("--check", action="store_true", help="verify the bundle, run its self-test, show the joints, and end")
    add("--rate", type=_positive, metavar="HZ", help="control steps a second (default: as in training)")
    add(
        "--trigger",
        choices=("timer", "joint_states"),
        default="timer",
        help="act by the clock, or on each joint state (default: timer)",
    )
    add(
        "--timeout",
        type=_positive,
        metavar="SECONDS",
        help="age at which measurements are too old [s] (default: three control steps, at least 0.02)",
    )
    add(
        "--joints",
        dest="joints_file",
        type=Path,
        metavar="FILE",
        help="lines `policy_joint = robot_joint`, for joints with other names on the robot",
    )
    repeated: dict[str, Any] = {"action": "append", "default": [], "dest": "remappings"}
    add("--remap", **repeated, metavar="TOPIC:=NAME", help="use another topic; may be repeated")
    add("--controller", metavar="NAME", help="also publish std_msgs/Float64MultiArray on NAME/commands")
    add("--strict-limits", action="store_true", help="keep position targets within the joints' ranges")
    add("--domain", type=_whole, default=None, metavar="ID", help="ROS domain (default: ROS_DOMAIN_ID, or 0)")
    add("--namespace", default="/", help="of the node")
    add("--name", default="muster_policy", help="name of the node (default: muster_policy)")
    add("--distro", choices=DISTRIBUTIONS, default="jazzy", help="ROS 2 of the robot (default: jazzy)")
    add(
        "--connect",
        metavar="ENDPOINT",
        help="the router (default: tcp/localhost:7447, none with --listen)",
    )
    add("--listen", metavar="ENDPOINT", help="be a router on this endpoint, so that no rmw_zenohd is needed")
    add("--duration", type=_positive, metavar="SECONDS", help="end after this time (default: run until it is stopped)")
    add("--version", action="version", version=f"muster-policy {__version__}")
    return found


def _complete(settings: Settings, bundle: Bundle) -> None:
    """Check names, and fill in what depends on other options, the environment or the bundle. Raises Refused."""
    remap = {}
    for each in settings.remappings:
        topic, sign, name = each.partition(":=")
        if not (topic and sign and name):
            raise Refused(f"--remap {each}: expected TOPIC:=NAME, such as imu:=/imu/data")
        remap[topic] = _ros_name("--remap", name)
    settings.remap = remap
    settings.controller = settings.controller and _ros_name("--controller", settings.controller)
    settings.joints = read_joints(settings.joints_file, bundle.contract.joints) if settings.joints_file else {}
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if settings.domain is None and not text.isdigit():
        raise Refused(f"ROS_DOMAIN_ID={text}: expected an integer")
    settings.domain = int(text) if settings.domain is None else settings.domain
    if not 0 <= settings.domain <= 232:
        raise Refused(f"domain {settings.domain}: expected 0 to 232")
    settings.connect = settings.connect or (None if settings.listen else "tcp/localhost:7447")
    settings.namespace = _ros_name("--namespace", settings.namespace) if settings.namespace.strip("/") else "/"
    settings.name = _ros_name("--name", settings.name)


def read_joints(path: Path, known: Sequence[str]) -> dict[str, str]:
    """The robot's names of joints from a file of lines ``policy_joint = robot_joint``; ``#`` begins a comment.

    Args:
        path: Of the file.
        known: Joints of the policy.

    Raises:
        Refused: A line has another form or an unknown joint, or two joints of the policy have one name on the robot.
    """
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise Refused(f"--joints {path}: it can't be read ({reason})") from None
    found: dict[str, str] = {}
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        ours, equals, theirs = (part.strip() for part in text.partition("="))
        if not (ours and equals and theirs):
            raise Refused(f"--joints {path}, line {number}: expected policy_joint = robot_joint, found {text[:60]!r}")
        if ours not in known:
            raise Refused(
                f"--joints {path}, line {number}: the policy has no joint {ours}; {nearest(ours, sorted(set(known)))}"
            )
        found[ours] = theirs
    robot: dict[str, str] = {}
    for joint in dict.fromkeys(known):
        if (other := robot.setdefault(found.get(joint, joint), joint)) != joint:
            raise Refused(
                f"--joints {path}: {other} and {joint} of the policy are both {found.get(joint, joint)} of the robot; give each its own"
            )
    return found


def _introduce(node: PolicyNode, bundle: Bundle) -> None:
    trained = bundle.contract.control_hz
    if node.rate != trained:
        _say(f"warning: --rate {node.rate:g}: the policy was trained at {trained:g} Hz")
    if (unit := node.observations.unit) is not None:
        _say(f"imu: in the frame of {unit.name}, on {unit.body}")
    elif IMU in node.observations.needs:
        _say("imu: in the frame of the robot's root body")
    if node.settings.controller:
        _say(f"{node.settings.controller}: its parameter must be joints: [{', '.join(node.commands.joints)}]")
    _say("joints, whose controllers must have these gains:")
    for line in node.commands.table():
        _say(line)


def _ros_name(option: str, text: str) -> str:
    """A valid ROS name. Raises Refused."""
    parts = text.removeprefix("/").split("/")
    if not all(re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", part) for part in parts):
        raise Refused(f"{option} {text}: a name of ROS has letters, digits and _ between its slashes, no digit first")
    if option == "--name" and "/" in text:
        raise Refused(f"--name {text}: a node's name has no slash; give --namespace besides")
    return text


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"expected a number above 0, found {text}")
    return value


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected an integer, found {text}") from None


def _say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
