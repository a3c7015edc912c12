"""The last answer of a backend: fresh, stale and missing."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from math import inf
from queue import SimpleQueue

import pytest

from orchestrator.engines.api import EngineError, NotYet
from orchestrator.engines.slurm import commands
from orchestrator.engines.slurm import engine as slurm
from orchestrator.engines.toolkit.view import CachedView, View
from tests.conftest import wait_for


def test_what_is_told_replaces_what_was_told_before_and_ends_the_trouble() -> None:
    view = View("nothing")
    assert (view.value, view.age, view.trouble) == ("nothing", inf, None)
    view.answered("first", 10.0)
    view.missed("away")
    assert (view.value, view.taken, view.trouble) == ("first", 10.0, "away"), "stale, and it says so"
    view.answered("second", 20.0)
    view.answered("older", 15.0)
    assert (view.value, view.taken, view.trouble) == ("second", 20.0, None)


class Backend:
    """Answers what a test puts there, and hangs while there is nothing."""

    def __init__(self) -> None:
        self.answers: SimpleQueue[str | Exception] = SimpleQueue()
        self.asked = 0

    def __call__(self) -> str:
        self.asked += 1
        answer = self.answers.get()
        if isinstance(answer, Exception):
            raise answer
        return answer


@pytest.fixture
def backend() -> Iterator[Backend]:
    found = Backend()
    yield found
    found.answers.put("the end")  # of a thread that still asks


@pytest.fixture
def view(backend: Backend) -> CachedView[str]:
    return CachedView("nothing", backend, name="view", silence="no answer yet")


def test_a_value_comes_at_once_without_patience_and_is_read_again_once_it_is_too_old(
    backend: Backend, view: CachedView[str]
) -> None:
    assert view.get(0.0) == "nothing" and view.trouble is None
    backend.answers.put("first")
    wait_for(lambda: view.value == "first", 10, "the answer")
    assert view.get(60.0, patience=60.0) == "first" and view.get(60.0, patience=60.0) == "first"
    assert backend.asked == 1, "it holds for a minute"
    backend.answers.put("second")
    assert view.get(0.0, patience=60.0) == "second"


def test_a_backend_that_fails_leaves_the_old_value_and_says_why_it_is_stale(
    backend: Backend, view: CachedView[str]
) -> None:
    backend.answers.put("first")
    view.read()
    backend.answers.put(NotYet("the daemon is away"))
    assert view.get(0.0, patience=60.0) == "first" and view.trouble == "the daemon is away" and view.age < inf
    assert view.get(60.0, patience=60.0) == "first" and backend.asked == 2, "a failure is not tried again at once"
    backend.answers.put(EngineError("refused"))
    with pytest.raises(EngineError, match="refused"):
        view.read()
    assert view.trouble == "refused"
    backend.answers.put("second")
    assert view.read() == "second" and view.trouble is None


def test_a_backend_that_hangs_delays_one_caller_and_is_asked_once(backend: Backend, view: CachedView[str]) -> None:
    assert view.get(0.0, patience=0.01) == "nothing" and view.trouble == "no answer yet"
    assert [view.get(0.0, patience=600.0) for _ in range(3)] == ["nothing"] * 3, "later callers don't wait"
    assert backend.asked == 1
    backend.answers.put("first")
    wait_for(lambda: view.value == "first" and view.trouble is None, 10, "the answer")


def test_a_bug_in_the_reading_is_trouble_and_not_the_end_of_the_view(
    backend: Backend, view: CachedView[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[BaseException | None] = []
    monkeypatch.setattr(threading, "excepthook", lambda told: seen.append(told.exc_value))
    backend.answers.put(KeyError("hosts"))
    assert view.get(0.0, patience=60.0) == "nothing" and view.trouble == "KeyError: 'hosts'"
    wait_for(lambda: [type(each) for each in seen] == [KeyError], 10, "its traceback")
    backend.answers.put("first")
    assert view.get(0.0, patience=60.0) == "first"


def test_a_slurm_that_went_away_can_t_tell_its_hosts_and_its_last_answer_is_not_taken_for_the_truth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    answers = ["NodeName=n1 CPUTot=4 RealMemory=1000 State=IDLE"]

    def call(*command: str, **_: object) -> str:
        if not answers:
            raise commands.Unreachable("slurmctld does not answer")
        return answers[0] if "nodes" in command else ""

    monkeypatch.setattr(commands, "call", call)
    monkeypatch.setattr(slurm, "_HOSTS_AGE", 0.0)
    engine = slurm.SlurmEngine()
    assert [host.name for host in engine.capacity().machines] == ["slurm/n1"]
    answers.clear()

    def problem() -> str:
        try:
            engine.capacity()
        except NotYet as error:
            return str(error)
        return ""

    assert wait_for(problem, 10, "the trouble") == "Slurm: slurmctld does not answer"
    answers.append("NodeName=n2 CPUTot=4 RealMemory=1000 State=IDLE")
    wait_for(lambda: not problem() and engine.capacity().machines[0].name == "slurm/n2", 10, "the recovery")
