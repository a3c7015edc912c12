"""When the node commands, what, and when it stops, without a clock and without a network; what is printed."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from muster_policy import timing as module
from muster_policy.actions import Commands, limits
from muster_policy.bundle import open_bundle
from muster_policy.errors import Refused
from muster_policy.inputs import Inputs
from muster_policy.messages import JOINT_STATE, Messages
from muster_policy.observations import Observations
from muster_policy.policy import Policy
from muster_policy.runner import Mode, Runner
from muster_policy.timing import Lines
from shared_store.contract.policy import Action
from tests.support.policy_node import for_node, write_bundle
from tests.support.refusals import refusal
from tests.unit.policy_node.walker import JOINTS, KNEE, contract, term

MESSAGES = Messages()
SPEED = term("joint_velocity", 0, 2, **JOINTS)
LAST = term("last_action", 2, 1, kind="previous_action", element="action", elements=("knee",))
TIMEOUT = 0.06


class Rig:
    """A runner of a linear policy that reads two velocities and its last action."""

    def __init__(self, folder: Path, weights: tuple[float, ...] = (1.0, 0.0, 0.5), recurrent: bool = False) -> None:
        column = np.array(weights)[:, None]
        bundle = open_bundle(write_bundle(folder / "bundle", contract(SPEED, LAST, recurrent=recurrent), column))
        policy = Policy(bundle)
        policy.self_test(bundle.parity)
        observations = Observations(bundle.contract)
        self.inputs = Inputs(observations, MESSAGES)
        self.commanded: list[float] = []
        self.lines: list[str] = []
        self.runner = Runner(
            self.inputs,
            observations,
            policy,
            Commands(bundle.contract),
            TIMEOUT,
            lambda command: self.commanded.append(float(command.values[0])),
            lambda line, warning: self.lines.append(line),
        )

    def step(self, now: float, knee: float | None = None, position: float = 0.1) -> bool:
        """A control step, before which the knee's velocity may come, at that moment."""
        if knee is not None:
            message = MESSAGES.make(
                JOINT_STATE,
                header=MESSAGES.header(0),
                name=["knee", "wheel"],
                position=np.array([position, 0.0]),
                velocity=np.array([knee, 0.0]),
                effort=np.zeros(0),
            )
            self.inputs.all[0].waiting = MESSAGES.encode(message, JOINT_STATE), now
        return self.runner.step(now)


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path)


def test_nothing_is_commanded_before_all_inputs_have_come(rig: Rig) -> None:
    assert not rig.step(0.0) and rig.commanded == []
    assert rig.step(0.02, knee=0.4) and rig.commanded == [pytest.approx(0.3 + 0.5 * 0.4)]
    assert rig.lines == ["all inputs have arrived: it commands the joints now, in a new episode"]


def test_the_policy_observes_its_last_action_unclipped(rig: Rig) -> None:
    rig.step(0.0, knee=3.0)
    rig.step(0.02, knee=0.0)
    # asked for 3, clipped to 2 for the joint; then half of the 3 that it asked for
    assert rig.commanded == [pytest.approx(0.3 + 0.5 * 2.0), pytest.approx(0.3 + 0.5 * 1.5)]


def test_a_silent_input_stops_the_node_with_one_last_command_that_holds_the_joints(rig: Rig) -> None:
    rig.step(0.0, knee=0.4, position=0.1)
    assert rig.step(0.05), "not too old yet"
    supplied = len(rig.commanded)
    assert not rig.step(0.07, knee=float("nan")) and rig.commanded[supplied:] == [pytest.approx(0.1)]
    assert "joint_states: message ignored: not finite: its velocities" in rig.lines, "which is silence"
    assert not rig.step(0.09) and len(rig.commanded) == supplied + 1, "and no further one"
    assert rig.lines[-1].startswith(
        "joint_states is silent for 70 ms: one last command holds the joints where they are"
    )
    assert "it resumes when no input has been older than 60 ms (--timeout) for 0.5 s" in rig.lines[-1]
    assert [rig.step(0.1 + 0.05 * step, knee=0.2) for step in range(9)] == [False] * 9
    assert rig.step(0.6, knee=0.2), "it goes on by itself"
    assert rig.commanded[-1] == pytest.approx(0.3 + 0.5 * 0.2), "with a fresh episode: there is no last action"


def test_an_input_slower_than_the_timeout_does_not_start_and_stop_the_robot_again_and_again(rig: Rig) -> None:
    acted = [rig.step(0.02 * step, knee=0.2 if step % 5 == 0 else None) for step in range(200)]
    assert acted.count(True) == 4 and rig.runner.counts.stops == 1, "it acts until the first gap, and then no more"


def test_an_action_that_is_not_finite_is_never_commanded_and_stops_the_node_until_it_is_reset(tmp_path: Path) -> None:
    rig = Rig(tmp_path, weights=(1e36, 0.0, 0.0))
    assert not rig.step(0.0, knee=1e3), "more than 32 bits hold"
    assert rig.commanded == [pytest.approx(0.1)] and rig.runner.mode is Mode.STOPPED
    assert rig.lines[-1].startswith("the policy's action for knee is not finite: one last command holds")
    assert not rig.step(0.02, knee=0.0) and len(rig.commanded) == 1, "although it would be finite again"
    rig.runner.reset()
    assert rig.step(0.04, knee=0.0) and rig.commanded[-1] == pytest.approx(0.3)


def test_an_observation_that_is_not_finite_is_never_given_to_the_policy(rig: Rig) -> None:
    assert not rig.step(0.0, knee=1e300), "a finite number of 64 bits that is infinite in 32"
    assert rig.lines[-1].startswith("the observation obs is not finite") and rig.commanded == [pytest.approx(0.1)]


def test_a_reset_forgets_the_recurrent_state(tmp_path: Path) -> None:
    rig = Rig(tmp_path, weights=(1.0, 0.0, 0.0), recurrent=True)
    for step, total in enumerate((0.1, 0.2, 0.3)):
        rig.step(0.02 * step, knee=0.1)
        assert rig.commanded[-1] == pytest.approx(0.3 + 0.5 * total)
    rig.runner.reset()
    rig.step(0.06, knee=0.1)
    assert rig.commanded[-1] == pytest.approx(0.3 + 0.5 * 0.1)


def test_the_end_holds_the_joints_where_the_node_commands_them(rig: Rig, tmp_path: Path) -> None:
    idle = Rig(tmp_path / "idle")
    rig.step(0.0, knee=0.4)
    idle.runner.end("the node ends")
    assert (idle.commanded, idle.lines, idle.step(0.01, knee=0.4)) == ([], [], False), "before it commanded anything"
    rig.runner.end("the node ends")
    assert rig.lines[-1] == "the node ends: one last command holds the joints where they are"
    assert rig.commanded[-1] == pytest.approx(0.1) and not rig.step(0.01, knee=0.4)


def test_commands_stay_within_limits() -> None:
    """Beyond its range a position target may be as far as it still changes the torque: 10 N m over 20 N m/rad."""
    assert limits(for_node(contract()).actions[0], False) == (-1.5, 1.5)
    assert limits(for_node(contract()).actions[0], True) == (-1.0, 1.0)
    wide = Action("knee", "position", "rad", scale=1.0, default_position=0.0, clip=None, range=(-1.0, 1.0))
    strict = Commands(for_node(contract(actions=(wide,))), strict=True)
    command = strict.command(np.array([7.0], np.float32))
    assert command.values.tolist() == [1.0] and command.limited == 1
    motor = Action("knee", "effort", "N m", scale=50.0, default_position=0.0, effort_limit=30.0)
    effort = Commands(for_node(contract(actions=(motor,)))).command(np.array([-1.0], np.float32))
    assert effort.values.tolist() == [-30.0] and effort.limited == 1


def test_each_kind_of_command_is_a_message_of_its_own_with_the_robot_s_names() -> None:
    wheel = Action("wheel", "velocity", "rad/s", scale=3.0, default_position=0.0)
    both = for_node(contract(actions=(KNEE, wheel), action_names=("knee", "wheel")))
    commands = Commands(both, {"wheel": "left_wheel"})
    first, second = commands.joint_states(commands.command(np.array([1.0, -1.0], np.float32)), MESSAGES, 5)
    assert (first.name, first.position.tolist(), len(first.velocity)) == (["knee"], [0.8], 0)
    assert (second.name, second.velocity.tolist(), len(second.position)) == (["left_wheel"], [-3.0], 0)
    assert commands.hold({"knee": 0.25, "wheel": 7.0}).values.tolist() == [0.25, 0.0]
    table = commands.table()
    assert "knee" in table[0] and "stiffness 20, damping 1, effort up to 10" in table[0] and "left_wheel" in table[1]


SLOW = Action("knee", "position", "rad", 1.0, 0.0, rule="It follows value slowly.")
NO_JOINTS = {
    "what its actions are: left, right": {
        "actions": (),
        "action_names": ("left", "right"),
        "discrete": True,
    },
    "does not say what its actions are: knee": {"actions": (), "action_names": ("knee",)},
    "the command of knee has a rule that the node lacks: It follows value slowly.": {"actions": (SLOW,)},
}


@pytest.mark.parametrize("output", NO_JOINTS)
def test_a_policy_that_drives_no_joints_is_refused_in_one_line(output: str) -> None:
    changes = NO_JOINTS[output]
    assert output in refusal(Commands, for_node(contract(SPEED, LAST, **changes)), error=Refused)


def test_a_stopped_terminal_does_not_block_and_later_lines_are_dropped() -> None:
    goes_on, output = threading.Event(), list[str]()

    def report(line: str) -> None:
        goes_on.wait()
        output.append(line)

    lines = Lines(report)
    for number in range(2 * module.MOST):
        lines.say(str(number))
    assert output == []
    goes_on.set()
    while len(output) < module.MOST:
        pass
    lines.say("the end")
    lines.close()
    assert output[:3] == ["0", "1", "2"] and output[-1] == "the end" and len(output) <= module.MOST + 2
