"""Forces from outside: what they do follows by hand, since the sliders know neither gravity nor contacts."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from tests.support.refusals import refusal
from tests.support.worker.declared import Small, SmallConfig
from worker.tasks import Event, ExternalWrench, Observation, terms

FORCE, SECONDS = 4.0, 1.0 / SmallConfig.control_hz


class Windy(Small):
    """Wind on the outer slider, of 1 kg, as long as an episode lasts: 10 steps."""

    events: dict[str, Event] = {"wind": Event(terms.apply_wrench, force=(FORCE, FORCE), torque=(-9.0, 9.0))}
    pushed: dict[str, ExternalWrench] = {"push": ExternalWrench("far")}

    def sections(self) -> dict[str, Any]:
        events = {"place": Event(terms.reset_to_default), **self.events}
        return {"sensors": self.pushed, "observations": {"speed": Observation(terms.joint_velocity)}, "events": events}


class Bumped(Windy):
    """A push of two steps every four steps."""

    events = {
        "bump": Event(terms.apply_impulse, when="interval", seconds=(0.4, 0.4), duration=(0.2, 0.2), force=(4.0, 4.0))
    }


class Both(Windy):
    """Refused: who would know which of them counts?"""

    pushed = {"push": ExternalWrench("far"), "pull": ExternalWrench("*a*")}
    events = {"wind": Event(terms.apply_wrench, wrench="push")}


def gains(task: Any, steps: int) -> torch.Tensor:
    """How much faster each joint is after each step, shape ``(steps, worlds, 2)``; a reset shows as its sign."""
    rest, speeds = torch.zeros(task.world_count, 2), [task.observations.clone()]
    for _ in range(steps):
        task.step(rest)
        speeds.append(task.observations.clone())
    return torch.stack(speeds).diff(dim=0)


def made(kind: type[Windy], seconds: float = 1.0, worlds: int = 2) -> Any:
    task = kind(SmallConfig(episode_seconds=seconds), worlds, seed=3)
    task.reset()
    return task


def test_a_wrench_acts_until_the_episode_ends_and_on_its_body_alone() -> None:
    found = gains(made(Windy), 12)
    still = torch.zeros(2)
    for step in (*range(9), 10, 11):  # in the tenth the next episode begins
        assert torch.allclose(found[step, :, 1], still + FORCE * SECONDS, atol=1e-5), step
        assert torch.allclose(found[step, :, 0], still, atol=1e-5), step


def test_an_impulse_ends_by_itself_and_with_its_episode() -> None:
    found = gains(made(Bumped, seconds=10.0), 16)[:, 0, 1]
    pushed = [4, 5, 8, 9, 12, 13]
    assert found.tolist() == pytest.approx([FORCE * SECONDS * (step in pushed) for step in range(16)], abs=1e-5)

    task = made(Bumped, seconds=0.5)  # a bump begins behind the fourth step, and the episode ends behind the fifth
    gains(task, 4)
    assert task.sensors["push"].state_tensors()["left"].tolist() == pytest.approx([0.2, 0.2])
    gains(task, 1)
    state = task.sensors["push"].state_tensors()
    assert not state["left"].any() and not state["wrenches"].any()


def test_a_checkpoint_knows_what_acts() -> None:
    one, other = made(Bumped, seconds=10.0), made(Bumped, seconds=10.0)
    gains(one, 5)
    other.load_state_dict({name: value.clone() for name, value in one.state_dict().items()})
    assert torch.equal(gains(one, 6), gains(other, 6))


def test_two_declarations_of_one_body_are_refused() -> None:
    assert "sensors.pull: ExternalWrench.bodies: far is pushed by another ExternalWrench" in refusal(made, Both)
