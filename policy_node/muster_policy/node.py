"""The policy node: a bundle's policy between the topics of a robot, step by step at its rate."""

from __future__ import annotations

import argparse
import gc
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from muster_policy.actions import Command, Commands
from muster_policy.bundle import Bundle
from muster_policy.errors import Refused
from muster_policy.graph import Answer, Node, open_session
from muster_policy.inputs import Inputs
from muster_policy.messages import ARRAY, DIAGNOSTICS, EMPTY, JOINT_STATE, LOG, NOTHING, RESET, Messages
from muster_policy.observations import Observations
from muster_policy.policy import Policy
from muster_policy.runner import Mode, Runner
from muster_policy.timing import Figures, Lines, sleep_until
from muster_policy.wire import Qos

REPORT = 10.0
"""Time between two lines about the loop [s]."""
PATIENCE = 5.0
"""Time between two lines about missing inputs [s]."""
SLOW = 0.8
"""Share of the rate below which the node warns."""


@dataclass(frozen=True)
class _Report:
    """The counts at a moment [s, monotonic]."""

    time: float
    steps: int = 0
    joints: int = 0
    stops: int = 0


class Settings(argparse.Namespace):
    """Settings of the node: the options of the command, ``muster-policy --help``."""

    rate: float | None
    """Control steps per second; None: as in training."""
    trigger: str
    timeout: float | None
    """Age from which a measurement is too old [s]; None: three control steps, at least 20 ms."""
    strict_limits: bool
    controller: str | None
    joints: Mapping[str, str]
    """Name of a joint on the robot by its name in the contract, if it differs."""
    remap: Mapping[str, str]
    """Replacement topics by the node's topics."""
    distro: str
    domain: int
    connect: str | None
    listen: str | None
    namespace: str
    name: str
    duration: float | None


class PolicyNode:
    """A node from a bundle; nothing is opened before :meth:`run`.

    Args:
        bundle: Verified.
        settings: Its settings.
        policy: Of the bundle, after its self-test.
        report: Called with each line of text.

    Raises:
        Refused: The policy needs a quantity that no message has, or a setting does not fit.
    """

    def __init__(
        self, bundle: Bundle, settings: Settings, policy: Policy, report: Callable[[str], None] = print
    ) -> None:
        self.settings, self._report, self._print = settings, report, report
        contract = bundle.contract
        self.rate = settings.rate or contract.control_hz
        self.messages = Messages(settings.distro)
        self.observations = Observations(contract)
        self.commands = Commands(contract, settings.joints, settings.strict_limits)
        if settings.controller and len(self.commands.kinds) > 1:
            raise Refused(
                f"--controller {settings.controller}: the policy commands {' and '.join(self.commands.kinds)}, a "
                "controller takes one kind; leave it out and use joint_commands"
            )
        self.inputs = Inputs(self.observations, self.messages, settings.joints)
        known = {each.topic for each in self.inputs.all} | {"joint_commands"}
        for topic in settings.remap:
            if topic not in known:
                raise Refused(f"--remap {topic}: the node has no such topic; it has {', '.join(sorted(known))}")
        self.timeout = settings.timeout or max(3.0 / self.rate, 0.02)
        self.figures = Figures()
        self.stopping, self._reset = threading.Event(), threading.Event()
        self._asking: deque[Answer] = deque()
        """Requests of a reset that wait for their answer."""
        self.runner = Runner(
            self.inputs, self.observations, policy, self.commands, self.timeout, self._publish, self._say
        )
        self._lines: list[tuple[str, bool]] = []
        self._last_report = _Report(time.monotonic())

    def run(self) -> None:
        """Run the node until :attr:`stopping` is set, or the duration is over. Raises Refused if Zenoh can't be opened."""
        settings, lines = self.settings, Lines(self._print)
        self._report = lines.say
        with open_session(settings.connect, settings.listen) as session:
            self._node = node = Node(session, self.messages, settings.domain, settings.namespace, settings.name)
            try:
                self._connect(node)
                if settings.listen is None and not session.info.routers_zid():
                    self._report(
                        f"no router answers at {settings.connect}; it is tried again (start rmw_zenohd, or give --listen)"
                    )
                self._loop()
            finally:
                self.runner.end("the node ends")
                self._flush()
                self._report(self.summary())
                lines.close()
                node.close()

    def _connect(self, node: Node) -> None:
        remap = self.settings.remap
        topics = {each.topic: node.full_name(remap.get(each.topic, each.topic)) for each in self.inputs.all}
        self._topics = topics
        self.runner.topics = topics
        out = node.full_name(remap.get("joint_commands", "joint_commands"))
        self._out = node.publisher(out, JOINT_STATE)
        controller = self.settings.controller
        self._controller = node.publisher(f"{controller}/commands", ARRAY) if controller else None
        self._log = node.publisher("/rosout", LOG, Qos(depth=1000, transient_local=True))
        self._diagnostics = node.publisher("/diagnostics", DIAGNOSTICS)
        node.watch_graph()

        def receive(data: bytes, kind: str, type_hash: str) -> None:
            if kind == EMPTY:
                self._request_reset()

        node.subscribe("~/reset", EMPTY, receive)
        node.serve("~/reset", RESET, self._request_reset)
        for each in self.inputs.all:
            node.subscribe(topics[each.topic], each.kind, self.inputs.hear(each, topics[each.topic]))
        self._report(f"node {node.full_name('~/')[:-1]} of domain {node.domain}: {', '.join(topics.values())} -> {out}")

    def _request_reset(self, answer: Answer | None = None) -> None:
        if answer is not None:
            self._asking.append(answer)
        self._reset.set()

    def _loop(self) -> None:
        gc.collect()
        gc.freeze()  # exempt permanent objects from garbage collection
        begin = time.monotonic()
        ends = begin + (self.settings.duration or float("inf"))
        second, patience, report = begin + 1.0, begin + 1.0, begin + REPORT
        self._deadline = begin
        while not self.stopping.is_set():
            due = self._wait(1.0 / self.rate)
            now = time.monotonic()
            if now > ends:
                break
            if self._reset.is_set():
                self._reset.clear()
                waiting = [self._asking.popleft() for _ in range(len(self._asking))]
                self.runner.reset()
                for answer in waiting:  # those that asked before it began
                    answer(NOTHING)
            if self.runner.step(now, due=due is not None) and due is not None:
                done = time.monotonic()
                self.figures.add("late", now - due)
                self.figures.add("step", done - now)
                self.figures.add("joint state to command", done - self.inputs.all[0].arrived)
            self._flush()
            if now > second:
                second = now + 1.0
                self._diagnose()
            if self.runner.mode is Mode.WAITING and now > patience:
                patience = now + PATIENCE
                self._report_missing()
            if now > report:
                report = now + REPORT
                self._report(self.summary())
                self._check_rates(now)

    def _wait(self, period: float) -> float | None:
        """Wait for the next control step; returns the time at which it was due, None if no joint state has arrived for it."""
        if self.settings.trigger == "timer":
            due, now = self._deadline + period, time.monotonic()
            self._deadline = now if now > due + period else due  # missed steps are not made up
            sleep_until(due)
            return due
        joints, earliest = self.inputs.all[0], self._deadline + 0.75 * period
        limit = time.monotonic() + min(self.timeout, 0.1)
        with self.inputs.news:
            while joints.waiting is None or joints.waiting[1] < earliest:
                left = limit - time.monotonic()
                if left <= 0.0:
                    return None
                self.inputs.news.wait(left)
            arrived = joints.waiting[1]
        due = self._deadline + period
        self._deadline = arrived if arrived > due + period else due  # a late joint state does not delay the next step
        return arrived

    def _publish(self, command: Command) -> None:
        for message in self.commands.joint_states(command, self.messages, time.time_ns()):
            self._out.publish(message)
        if self._controller is not None:
            self._controller.publish(self.messages.array(command.values))

    def _say(self, line: str, warning: bool) -> None:
        """Keep a line until the step is over."""
        self._lines.append((line, warning))

    def _flush(self) -> None:
        lines, self._lines = self._lines, []
        for line, warning in lines:
            self._report(line)
            place = {"name": self._node.name, "file": "", "function": "", "line": 0}
            stamp = self.messages.stamp(time.time_ns())
            self._log.publish(self.messages.make(LOG, stamp=stamp, level=30 if warning else 20, msg=line, **place))

    def _diagnose(self) -> None:
        make, counts, mode = self.messages.make, self.runner.counts, self.runner.mode
        values = {"steps": counts.steps, "limited": counts.limited, "stops": counts.stops}
        values["ignored"] = sum(self.inputs.ignored.values())
        pairs = [make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in values.items()]
        status = make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level={Mode.ACTING: 0, Mode.WAITING: 1, Mode.STOPPED: 2, Mode.ENDED: 2}[mode],
            name=f"{self._node.name}: policy",
            message=mode.value,
            hardware_id="",
            values=pairs,
        )
        self._diagnostics.publish(make(DIAGNOSTICS, header=self.messages.header(time.time_ns()), status=[status]))

    def _report_missing(self) -> None:
        for each in self.inputs.missing():
            topic, publishers = self._topics[each.topic], self._node.publishers()
            here = [other for other in publishers if other.name == topic]
            others = sorted({other.name for other in publishers if other.type == each.kind} - {topic, self._out.topic})
            if wrong := [other for other in here if other.type != each.kind]:
                how = f"{wrong[0].node} publishes {wrong[0].type} there"
            elif here:
                how = f"{here[0].node} publishes it, and no message could be used yet"
            elif others:
                how = f"nobody publishes it; it may be {others[0]}: --remap {each.topic}:={others[0]}"
            else:
                how = "nobody publishes it"
            self._report(f"waiting for {topic} ({each.kind}): {how}")

    def _check_rates(self, now: float) -> None:
        """Warn if control steps or joint states come less often than in the policy's training."""
        counts, before = self.runner.counts, self._last_report
        this = self._last_report = _Report(now, counts.steps, self.inputs.all[0].count, counts.stops)
        if self.runner.mode is not Mode.ACTING or not before.steps or this.stops != before.stops:
            return
        seconds = this.time - before.time
        for what, count in (("it acts", this.steps - before.steps), ("joint states come", this.joints - before.joints)):
            if count / seconds < SLOW * self.rate:
                self._say(
                    f"warning: {what} at {count / seconds:.1f} Hz, and the rate of control is {self.rate:g} Hz", True
                )

    def summary(self) -> str:
        """One line about the loop so far."""
        counts, ignored = self.runner.counts, sum(self.inputs.ignored.values())
        return (
            f"{self.runner.mode.value}: {counts.steps} steps at {self.rate:g} Hz, {counts.limited} commands limited, "
            f"{counts.stops} stops, {counts.resets} resets, {ignored} messages ignored; {self.figures.line()}"
        )
