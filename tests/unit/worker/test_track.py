"""Sending a run's metrics: what a service gets over kills, resumed attempts, and its own absence."""

from __future__ import annotations

import json
import runpy
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume.epoch import raise_epoch
from shared_store.volume.files import write_json
from shared_store.volume.layout import Run, Store
from shared_store.volume.metrics import MetricsWriter, scalars
from tests.conftest import REPOSITORY
from worker import track
from worker.learning.job import Job
from worker.telemetry.services import Service, TrainingEnd
from worker.track import Sender, SenderLock

TRAIN = {"task": "Cartpole", "ppo": {"learning_rate": 0.001}}


class Memory(Service):
    """A service that remembers what it was sent, by the name of the run."""

    def __init__(self) -> None:
        self.sent: dict[str, list[tuple[int, float]]] = {}
        self.left: list[str] = []
        self.ended: list[TrainingEnd] = []
        self.trouble: Exception | None = None
        self.identity = ""

    def prepare(self) -> None:
        pass

    def open(self, identity: str | None, fresh: str) -> int:
        if self.trouble:
            raise self.trouble
        self.identity = identity or fresh
        return max((step for step, _ in self.sent.setdefault(self.identity, [])), default=0)

    @property
    def place(self) -> str:
        return f"memory of {self.identity}"

    def send(self, records: Sequence[Mapping[str, Any]]) -> None:
        if self.trouble:
            raise self.trouble
        self.sent[self.identity] += [(each["iteration"], each["reward"]) for each in records]

    def finish(self, ending: TrainingEnd) -> None:
        self.ended.append(ending)

    def leave(self) -> None:
        self.left.append(self.identity)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Store(tmp_path).open().run("ant")
    run.create({"spec": {"train": TRAIN}})
    return run


def write(run: Run, epoch: int, resumed_from: int, last: int) -> None:
    """The metrics of an attempt; its number is in each reward."""
    with MetricsWriter(run, epoch, resumed_from) as writer:
        for iteration in range(resumed_from + 1, last + 1):
            writer.write({"iteration": iteration, "reward": float(epoch), "time": 1.0})


def sender(run: Run, service: Memory, output: list[str], settings: Mapping[str, Any] = TRAIN) -> Sender:
    return Sender(run, service, "memory", settings, output.append)


def test_a_resumed_attempt_with_the_same_settings_sends_no_iteration_twice(run: Run) -> None:
    service, output = Memory(), list[str]()
    write(run, 1, 0, 10)
    assert sender(run, service, output).step(0, 1)
    write(run, 2, 6, 12)  # killed at 10, it goes on from a checkpoint of 6
    assert sender(run, service, output).step(6, 2)
    assert service.sent == {"ant": [(i, 1.0) for i in range(1, 11)] + [(11, 2.0), (12, 2.0)]}
    assert output == ["memory of ant"] * 2 and service.left == []


def test_iterations_that_are_done_again_with_other_settings_begin_a_new_run_with_the_whole_history(run: Run) -> None:
    service, output = Memory(), list[str]()
    write(run, 1, 0, 10)
    assert sender(run, service, output).step(0, 1)
    write(run, 2, 6, 8)
    others = {**TRAIN, "ppo": {"learning_rate": 0.1}}
    assert sender(run, service, output, others).step(6, 2)
    assert service.sent["ant"] == [(i, 1.0) for i in range(1, 11)] and service.left == ["ant"]
    assert service.sent["ant-e2"] == [(i, 1.0) for i in range(1, 7)] + [(7, 2.0), (8, 2.0)]
    write(run, 3, 8, 9)  # and that is the run from then on
    assert sender(run, service, output, others).step(8, 3)
    assert service.sent["ant-e2"][-1] == (9, 3.0)


def test_other_settings_from_the_last_iteration_on_continue_the_same_run(run: Run) -> None:
    service = Memory()
    write(run, 1, 0, 5)
    assert sender(run, service, []).step(0, 1)
    write(run, 2, 5, 6)
    assert sender(run, service, [], {"task": "Ant"}).step(5, 2)
    assert service.sent == {"ant": [(i, 1.0) for i in range(1, 6)] + [(6, 2.0)]}


def test_one_process_at_a_time_sends_a_run_and_the_next_one_learns_who_does(
    run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code = (
        "import sys; from pathlib import Path; from shared_store.volume.layout import Run; from worker.track import SenderLock; "
        "lock = SenderLock(Run(Path(sys.argv[1])), 'mlflow'); print(lock.take(), flush=True); sys.stdin.read()"
    )
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    other = subprocess.Popen([sys.executable, "-c", code, str(run.path)], cwd=REPOSITORY, **pipes)
    try:
        assert other.stdout is not None and other.stdout.readline() == "None\n"
        holder = f"process {other.pid} on {socket.gethostname()}"
        lock = SenderLock(run, "mlflow")
        assert lock.take() == holder and SenderLock(run, "wandb").take() is None
        described = {"run": run.name, "spec": {"train": TRAIN, "track": {"mlflow": {"uri": "x"}}}}
        write_json(run.path / "run.json", described)
        monkeypatch.setattr(track, "SERVICES", {"mlflow": lambda tracked, settings: Memory()})
        line = f"error: mlflow: {holder} sends this run already; run this again once its training is over\n"
        assert track.afterwards(str(run.path), "mlflow") == 2 and capsys.readouterr().err == line
    finally:
        other.kill()  # as a rank's death would end it
        other.wait()
        other.communicate()
    assert lock.take() is None and lock.take() is None


def test_an_unreachable_service_is_reported_in_one_line_and_everything_is_sent_later(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    service, output = Memory(), list[str]()
    sending = sender(run, service, output)
    write(run, 1, 0, 3)
    assert sending.step(0, 1)
    service.trouble = ConnectionError("no route\nto http://me:word@host/")
    write(run, 2, 3, 700)
    assert not sending.step(0, 1)
    assert not sending.step(0, 1)  # a moment later it is not even tried
    service.trouble = None
    assert not sending.step(0, 1)
    monkeypatch.setattr(track, "time", Later())
    assert sending.step(0, 1)
    assert [step for step, _ in service.sent["ant"]] == list(range(1, 701))
    warning = "warning: nothing can be sent now (no route to http://host/)"
    assert output[1:] == [warning, "it answers again; everything is sent"]


class Later:
    """An hour later."""

    @staticmethod
    def monotonic() -> float:
        return 1e9


def test_the_end_of_a_training_comes_with_its_evaluation_and_pictures_and_that_of_a_stopped_one_without(
    run: Run,
) -> None:
    service = Memory()
    write(run, 1, 0, 4)
    sending = sender(run, service, [])
    assert sending.step(0, 1)
    (run.metrics / "reward.png").write_bytes(b"png")
    run.evaluations.mkdir()
    summary = {"mean_return": 2.5, "mean_length": 9.0, "max_length": 10, "episodes": 3, "time": 1.0}
    summary |= {"success": {"share": 0.75}, "metrics": {"error_vel_xy": {"mean": 0.125}}}
    own = run.evaluations / "00000004-e1.json"
    own.write_text(json.dumps(summary))
    another = {**summary, "config": {"randomize": {}}, "time": 2}
    (run.evaluations / "00000004-e1-abc.json").write_text(json.dumps(another))
    sending.finish("stopped")
    sending.finish("finished")
    figures = {"return": 2.5, "length": 9.0, "success": 0.75, "error_vel_xy": 0.125}
    last = {f"evaluation/{name}": value for name, value in figures.items()}
    finished = TrainingEnd("finished", 4, last, [run.metrics / "reward.png", own])
    assert service.ended == [TrainingEnd("stopped", 4, {}, []), finished]


def test_a_records_numbers_have_the_names_that_tensorboard_shows() -> None:
    record = {"iteration": 3, "time": 5.0, "reward": None, "episode_length": 7.5, "kl": 0.01, "nan_worlds": 0}
    assert scalars(record) == {"episode/length": 7.5, "train/kl": 0.01, "train/nan_worlds": 0}


def job(run: Run, **requested: Any) -> Job:
    raise_epoch(run, 1)
    return Job({"train": TRAIN, "track": requested}, Store(run.path.parent.parent), run, 1, 1, "id", section=TRAIN)


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (["RUN"], "error: usage: python -m worker.track RUN_DIRECTORY wandb|mlflow"),
        (["RUN", "neptune"], "error: no service is called neptune; available: wandb, mlflow"),
        (["nowhere", "wandb"], "nowhere is not a run that a `train` job made; name a directory of runs/ in the store"),
    ],
)
def test_a_run_that_cannot_be_sent_afterwards_is_reported_in_one_line(
    run: Run, arguments: list[str], output: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["track", *(str(run.path) if each == "RUN" else each for each in arguments)])
    monkeypatch.delitem(sys.modules, "worker.track")
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("worker.track", run_name="__main__")
    out, errors = capsys.readouterr()
    assert (ended.value.code, out, errors.count("\n")) == (2, "", 1) and output in errors
