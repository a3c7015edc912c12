"""The toolkit of engines: environments, waiting, tries, stops, views of slow backends, outcomes, copied logs."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from math import inf
from pathlib import Path
from queue import SimpleQueue

import pytest

from orchestrator import machine
from orchestrator.engines.api import EngineError, Handle, NotYet, Transient
from orchestrator.engines.slurm import engine as slurm
from orchestrator.engines.slurm import slurm_commands
from orchestrator.engines.testing.rigs import make_gang
from orchestrator.engines.toolkit import log_copy
from orchestrator.engines.toolkit.backoff import Backoff
from orchestrator.engines.toolkit.environment import PRIVATE, inherited
from orchestrator.engines.toolkit.log_copy import LogCopy
from orchestrator.engines.toolkit.outcomes import all_recorded, log_of, record, recorded, seen, store_facts
from orchestrator.engines.toolkit.view import CachedView
from orchestrator.engines.toolkit.waiting import stop_within
from shared_store.contract.node import LOG_LIMIT
from shared_store.volume.layout import Store
from shared_store.volume.log_files import LogWriter
from tests.conftest import wait_for


def test_a_started_process_has_the_variables_that_programs_need_and_those_that_are_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ours = dict.fromkeys(PRIVATE, "secret")
    theirs = {"HOME": "/root", "LC_ALL": "C", "NCCL_DEBUG": "INFO", "AWS_CA_BUNDLE": "/ca", "PIP_CERT": "/ca"}
    others = ("KUBECONFIG", "PGHOST", "NVIDIA_API_KEY", "CONDA_TOKEN", "RAY_REDIS_PASSWORD", "PIP_INDEX_URL")
    others += ("PYTHON_KEYRING_PASSWORD", "MUSTER_MY_SECRETS", "HF_TOKEN")
    monkeypatch.setattr("os.environ", {**ours, **theirs, **dict.fromkeys(others, "hunter2")})
    del os.environ["MUSTER_INHERIT"]
    assert inherited() == theirs
    rest = {name: theirs[name] for name in ("NCCL_DEBUG", "AWS_CA_BUNDLE", "PIP_CERT")}
    assert inherited(["HOME"], ("LC_",), kept=["RAY_AUTH_TOKEN"]) == {**rest, "RAY_AUTH_TOKEN": "secret"}
    assert inherited(["HOME"], ("LC_",), kept=["HOME"]) == {**rest, "HOME": "/root"}
    os.environ["MUSTER_INHERIT"] = "HF_TOKEN NVIDIA_API_KEY MUSTER_TOKEN SLURM_JWT NOSUCH"
    named = {"HF_TOKEN": "hunter2", "NVIDIA_API_KEY": "hunter2"}
    assert inherited() == {**theirs, **named}, "and the controller's own never"
    assert inherited(named=["KUBECONFIG"]) == {**theirs, "KUBECONFIG": "hunter2"}


@pytest.fixture
def handle(tmp_path: Path) -> Handle:
    """Of a gang of two nodes whose run is in the store."""
    gang = make_gang("job", str(tmp_path), 2, "fake/host", ["any"])
    Store(tmp_path).open().run(gang.run).create({"run": gang.run})
    return Handle("fake", gang.name, 2, store_facts(gang))


def test_the_outcome_of_a_node_is_written_once_and_not_over_a_supervisor_s(handle: Handle) -> None:
    assert recorded(handle, 1) is None and all_recorded(handle) == {}
    record(handle, seen(handle, 1, 3, "", 1e9))
    record(handle, seen(handle, 1, 0, "later", 2e9))
    found = recorded(handle, 1)
    assert found is not None and all_recorded(handle) == {1: found}
    assert (found.exit_code, found.reason, found.ended) == (3, "container exited with code 3", 1e9)
    assert seen(handle, 0, 0, "", 1e9).reason == "done" and seen(handle, 0, 137, "OOM", 1e9).reason == "OOM"


def test_no_outcome_is_written_for_a_run_that_is_gone_or_through_a_link_in_its_place(
    handle: Handle, tmp_path: Path
) -> None:
    gone = replace(handle, facts={**handle.facts, "run": "gone"})
    record(gone, seen(gone, 0, 0, "", 1e9))
    assert recorded(gone, 0) is None and not Store(tmp_path).run("gone").path.exists()
    folder = Store(tmp_path).run(handle.facts["run"]).outcome("job", 1, 0).parent
    folder.parent.mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    folder.symlink_to(tmp_path / "elsewhere")
    record(handle, seen(handle, 0, 0, "", 1e9))
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_a_copied_log_has_each_line_once_whoever_copies(handle: Handle) -> None:
    path, limit = log_of(handle, 0)
    assert limit == LOG_LIMIT
    lines = [f"line {number} \udcff\n" for number in range(7)]
    with closing(LogCopy(path, limit)) as copy:
        copy.append(lines[:3])
        copy.append(lines[3:4])
    with closing(LogCopy(path, limit)) as copy:  # by a controller that starts from the beginning, in other pieces
        copy.append(lines[:2])
        copy.append(lines[2:6])
        copy.append(lines[6:])
    assert path.read_text() == "".join(f"line {number} \\udcff\n" for number in range(7))


def test_lines_for_which_there_was_no_room_are_written_later(handle: Handle, monkeypatch: pytest.MonkeyPatch) -> None:
    path, limit = log_of(handle, 0)
    room = [4]  # bytes

    class Full(LogWriter):
        def append(self, data: bytes) -> int:
            part = data[: room[0]]
            written = super().append(part[: part.rfind(b"\n") + 1])
            self.error = OSError(28, "No space left on device") if written < len(data) else None
            return written

    monkeypatch.setattr(log_copy, "LogWriter", Full)
    with closing(LogCopy(path, limit)) as copy:
        with pytest.raises(OSError, match="No space left"):
            copy.append(["a\n", "b\n", "c\n"])
        assert not copy.is_whole and path.read_text() == "a\nb\n"
        room[0] = 100
        copy.append(["d\n"])
        assert copy.is_whole
    assert path.read_text() == "a\nb\nc\nd\n"


def test_an_action_that_fails_at_every_other_try_is_logged_once_and_waits_longer_each_time(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    moment = 0.0
    monkeypatch.setattr(machine, "monotonic", lambda: moment)
    backoff = Backoff(logging.getLogger("test"), first=1.0, most=60.0)
    for pause in (1.0, 2.0, 4.0):
        backoff.failed("job", "can't end")
        moment += pause - 0.1
        assert backoff.waits("job")
        moment += 0.1
        assert not backoff.waits("job") and not backoff.worked("job", lasting=True)
    assert [record.getMessage() for record in caplog.records] == ["can't end"]
    moment += 3.9
    assert not backoff.worked("job", lasting=True) and backoff.failure("job") == "can't end"
    moment += 0.1
    assert backoff.worked("job", lasting=True) and not backoff


def stop(seconds: float, step: Callable[[], str]) -> None:
    stop_within(seconds, step, engine="fake", gang="job/1/1", pause=0.001)


def test_a_stop_goes_on_until_nothing_is_left_whether_the_backend_answers_or_not() -> None:
    answers = iter(["two nodes run", NotYet("no route"), "one node runs", "", "not asked for"])

    def step() -> str:
        answer = next(answers)
        if isinstance(answer, NotYet):
            raise answer
        return str(answer)

    stop(60.0, step)
    assert next(answers) == "not asked for"


def test_a_stop_that_is_never_answered_ends_with_the_last_answer_and_a_refused_one_at_once() -> None:
    for error, kind, words in (
        (EngineError("not authorized"), EngineError, "not authorized"),
        (NotYet("away"), Transient, "the fake engine has not ended gang job/1/1 within 0.02 s; last answer: away"),
    ):

        def step(error: EngineError = error) -> str:
            raise error

        with pytest.raises(kind) as raised:
            stop(0.02, step)
        assert str(raised.value) == words


class Backend:
    """Answers what a test puts there, and hangs while there is nothing."""

    def __init__(self) -> None:
        self.answers: SimpleQueue[str | Exception] = SimpleQueue()
        self.requested = 0

    def __call__(self) -> str:
        self.requested += 1
        answer = self.answers.get()
        if isinstance(answer, Exception):
            raise answer
        return answer


def view_of(backend: Backend, patience: float = 60.0) -> CachedView[str]:
    return CachedView("nothing", backend, name="view", silence="no answer yet", patience=patience)


def test_a_value_is_read_again_once_it_is_too_old_and_a_failure_leaves_it_and_says_why_it_is_stale() -> None:
    backend = Backend()
    view = view_of(backend)
    assert (view.value, view.taken, view.trouble) == ("nothing", -inf, "")
    backend.answers.put("first")
    assert view.get(60.0) == "first" == view.get(60.0) and backend.requested == 1, "it holds for a minute"
    for error, words in ((NotYet("away"), "away"), (KeyError("hosts"), "KeyError: 'hosts'")):
        backend.answers.put(error)
        with suppress(KeyError):
            assert view.get(0.0) == "first"
        requested = backend.requested
        assert view.get(60.0) == "first" and view.trouble == words and backend.requested == requested, (
            "not again at once"
        )
    backend.answers.put(EngineError("refused"))
    with pytest.raises(EngineError, match="refused"):
        view.read()
    backend.answers.put("second")
    assert view.read() == "second" and view.trouble == ""


def test_a_backend_that_hangs_delays_one_caller_and_is_asked_once() -> None:
    backend = Backend()
    view = view_of(backend, patience=0.05)
    assert view.get(0.0) == "nothing" and view.trouble == "no answer yet"
    assert [view.get(0.0) for _ in range(3)] == ["nothing"] * 3 and backend.requested == 1
    backend.answers.put("first")
    wait_for(lambda: view.value == "first" and not view.trouble, 10, "the answer")


def test_a_slurm_that_went_away_can_t_tell_its_hosts_and_its_last_answer_is_not_taken_for_the_truth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    answers = ["NodeName=n1 CPUTot=4 RealMemory=1000 State=IDLE"]

    def call(*command: str, **_: object) -> str:
        if not answers:
            raise slurm_commands.SlurmUnreachable("slurmctld does not answer")
        return answers[0] if "nodes" in command else ""

    monkeypatch.setattr(slurm_commands, "call", call)
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
