"""The runner of a control step: from measurements to a command, or to none; independent of clocks and networks."""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from muster_policy.actions import Command, Commands
from muster_policy.inputs import Inputs
from muster_policy.observations import Observations
from muster_policy.policy import Policy

SETTLED = 0.5
"""Time for which all inputs must be fresh, after one was too old, before the node commands again [s]."""


class Mode(enum.Enum):
    """Mode of the node."""

    WAITING = "waiting for inputs"
    ACTING = "acting"
    STOPPED = "stopped until it is reset"
    ENDED = "ended"


@dataclass
class Counts:
    """Counts so far."""

    steps: int = 0
    limited: int = 0
    stops: int = 0
    resets: int = 0


class Runner:
    """Decides in each control step whether to command, and what.

    It commands only while all measurements exist and are fresh, and the policy's actions are finite. Otherwise it gives one last
    command, which holds the robot where it is, and then stops. It resumes when inputs have been fresh for :data:`SETTLED`, so that an
    input slower than the timeout does not start and stop the robot repeatedly.

    Args:
        inputs: The measurements.
        observations: Builds the policy's observations.
        policy: After its self-test.
        commands: Makes commands.
        timeout: Age from which a measurement is too old [s].
        give: Called with each command.
        say: Called with each line of text, and whether it is a warning.
    """

    def __init__(
        self,
        inputs: Inputs,
        observations: Observations,
        policy: Policy,
        commands: Commands,
        timeout: float,
        give: Callable[[Command], None],
        say: Callable[[str, bool], None],
    ) -> None:
        self.inputs, self.observations, self.policy, self.commands = inputs, observations, policy, commands
        self.timeout, self._give, self._say = timeout, give, say
        self.mode, self.counts = Mode.WAITING, Counts()
        self._silent: set[str] = set()
        self._settled = -float("inf")
        """Time from which inputs count as settled [s, monotonic]."""
        self.topics: Mapping[str, str] = {}
        """Full names of the inputs' topics, for the lines."""

    def step(self, now: float, due: bool = True) -> bool:
        """Do one control step.

        Args:
            now: [s, monotonic].
            due: Whether to act; otherwise it only checks whether inputs are too old.

        Returns:
            Whether a command was given.
        """
        self.inputs.update(self.topics)
        for line in self.inputs.complaints():
            self._say(line, True)
        if self.mode in (Mode.STOPPED, Mode.ENDED) or self.inputs.missing():
            return False
        if stale := self.inputs.stale(now, self.timeout):
            if self.mode is Mode.ACTING:
                each, age = max(stale, key=lambda entry: entry[1])
                fresh = f"when no input has been older than {self.timeout * 1e3:.0f} ms (--timeout) for {SETTLED:g} s"
                self._stop(f"{self._topic(each.topic)} is silent for {age * 1e3:.0f} ms", fresh)
            if self.counts.stops:
                self._settled = now + SETTLED
            return False
        if slow := [each for each in self.inputs.all if each.is_too_slow(now)]:
            if self.mode is Mode.ACTING:
                why = f"{self._topic(slow[0].topic)} asks for less than any command in training"
                self._stop(why, "when that ends")
            return False
        if not due or (self.mode is Mode.WAITING and now < self._settled):
            return False
        if self.mode is Mode.WAITING:
            self._forget()
            self.mode = Mode.ACTING
            self._say("all inputs have arrived: it commands the joints now, in a new episode", False)
        return self._act(now)

    def reset(self) -> None:
        """Begin an episode: clear last action, history and recurrent state; a stopped node resumes."""
        self._forget()
        self.counts.resets += 1
        if self.mode is Mode.STOPPED:
            self.mode = Mode.WAITING
            self._say("reset: the node waits for its inputs", False)

    def end(self, why: str) -> None:
        """If the node commands the robot, hold it where it is; then give no further command."""
        if self.mode is Mode.ACTING:
            self._hold()
            self._say(f"{why}: one last command holds the joints where they are", False)
        self.mode = Mode.ENDED

    def _act(self, now: float) -> bool:
        silent = {each.topic for each in self.inputs.all if each.is_silent(now)}
        for topic in sorted(silent - self._silent):
            self._say(f"{self._topic(topic)} is silent: the command is velocity 0", True)
        self._silent = silent
        with np.errstate(over="ignore"):  # a float32 overflow is found below
            seen = self.observations.build(self.inputs.snapshot(now))
        for name, numbers in seen.items():
            if not np.isfinite(numbers).all():
                self._stop(f"the observation {name} is not finite")
                return False
        action = self.policy.act(seen)[0]
        if not np.isfinite(action).all():
            worst = self.commands.actions[int(np.flatnonzero(~np.isfinite(action))[0])].name
            self._stop(f"the policy's action for {worst} is not finite")
            return False
        self.observations.acted(action)
        command = self.commands.command(action)
        self._give(command)
        self.counts.steps += 1
        self.counts.limited += command.limited
        return True

    def _stop(self, why: str, goes_on: str | None = None) -> None:
        """Hold the robot; ``goes_on`` says in words when the node resumes; None: after a reset."""
        self._hold()
        self.mode = Mode.STOPPED if goes_on is None else Mode.WAITING
        self.counts.stops += 1
        self._say(
            f"{why}: one last command holds the joints where they are; it resumes {goes_on or 'after ~/reset'}", True
        )

    def _hold(self) -> None:
        positions, _ = self.inputs.all[0].value
        self._give(self.commands.hold(dict(zip(self.observations.joints, positions, strict=True))))

    def _forget(self) -> None:
        self.policy.reset()
        self.observations.reset()

    def _topic(self, topic: str) -> str:
        return self.topics.get(topic, topic)
