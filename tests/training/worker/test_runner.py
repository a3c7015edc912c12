"""The loop around PPO: resuming bit for bit, leaving when asked, damage, full disks, user errors."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import worker.export
import worker.train
from shared_store.contract.phases import Phase
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.support.worker.declared import Sliders
from tests.support.worker.in_process import call_worker
from tests.support.worker.ranks import run_ranks, training
from tests.support.worker.runs import assert_same_bits, last, runner, train
from worker.learning.cuda_graph import CudaGraphFunction
from worker.learning.distributed import RankPlacement
from worker.learning.job import StopRequest
from worker.learning.loop import Loop
from worker.settings.errors import GangError, TrainingError
from worker.tasks import Adaptive


class Climbing(Sliders):
    """Sliders with an adaptive number that takes a step in every iteration once episodes have ended."""

    def sections(self) -> dict[str, Any]:
        rule = Adaptive("events.kick.speed", 0.75, 1.75, steps=9, above=-1e6, below=-2e6)
        sections = super().sections()
        return sections | {"curricula": sections["curricula"] | {"kicks": rule}}


def test_a_resumed_run_ends_with_the_same_bits(tmp_path: Path) -> None:
    train(training(tmp_path, run="straight", iterations=6))
    train(training(tmp_path, run="stopped", iterations=3))
    torch.manual_seed(99)  # a new process has other generator states
    resumed = train(training(tmp_path, run="stopped", iterations=6, epoch=2))
    assert resumed.resumed is not None and resumed.resumed.iteration == 3
    assert last(tmp_path, "stopped").name == "00000006-e2"
    assert_same_bits(last(tmp_path, "straight"), last(tmp_path, "stopped"))
    with pytest.raises(AssertionError):  # the comparison can fail
        assert_same_bits(last(tmp_path, "straight"), list_checkpoints(Store(tmp_path).run("stopped"))[0].path)
    history = read_metrics(Store(tmp_path).run("stopped"))
    assert [record["iteration"] for record in history] == [1, 2, 3, 4, 5, 6]
    assert [record["env_steps"] for record in history] == [64 * i for i in range(1, 7)]


def resume_in_a_gang() -> int:
    """Body of a rank: a straight run and a stopped and resumed one, in one gang."""
    from worker.learning.distributed import connect

    torch.set_num_threads(1)
    gang = connect(RankPlacement.from_env(os.environ))
    store = Path(os.environ["MUSTER_STORE"])
    for settings in (
        {"run": "straight", "iterations": 6},
        {"run": "stopped", "iterations": 3},
        {"run": "stopped", "iterations": 6, "epoch": 2},
    ):
        train(training(store, **settings), gang)
    gang.close()
    return 0


@pytest.fixture(scope="module")
def two_ranks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with runs of two ranks of 8 worlds."""
    store = tmp_path_factory.mktemp("two-ranks")
    for code, output, errors in run_ranks("training.worker.test_runner:resume_in_a_gang", 2, training(store)):
        assert code == 0, output + errors
    return store


def test_a_resumed_gang_ends_with_the_same_bits(two_ranks: Path) -> None:
    assert sorted(p.name for p in last(two_ranks, "straight").glob("*.pt")) == ["learner.pt", "rank-0.pt", "rank-1.pt"]
    assert_same_bits(last(two_ranks, "straight"), last(two_ranks, "stopped"))


def test_worlds_are_dealt_out_again_to_another_number_of_ranks(two_ranks: Path) -> None:
    alone = runner(training(two_ranks, run="straight", worlds=16, iterations=7, epoch=3))
    assert alone.resumed is not None and alone.state.progress.iteration == 6
    shards = [
        torch.load(last(two_ranks, "straight") / f"rank-{k}.pt", weights_only=True)["worlds"]["state"] for k in (0, 1)
    ]
    for name, tensor in alone.task.state_dict().items():
        assert torch.equal(tensor, torch.cat([shard[name] for shard in shards])), name
    assert alone.train() == 0


def test_what_is_ordered_while_a_device_works_is_the_state_before_that_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a GPU: the copies are made at the end of an iteration, and ordered to be saved in the next one."""
    train(training(tmp_path, run="at-once", iterations=7, every=2))
    ordered: list[tuple[int, int]] = []
    order = Loop._order

    def noting(loop: Loop, *, wait: bool = False) -> None:
        ordered.append((loop.state.progress.iteration, loop.iterated))
        order(loop, wait=wait)

    monkeypatch.setattr(Loop, "_order", noting)
    monkeypatch.setattr(CudaGraphFunction, "can_be_captured", True)
    loop = runner(training(tmp_path, run="later", iterations=7, every=2))
    seen: list[bool] = []
    learn = loop.algorithm.learn

    def watched(observations: Any) -> Any:
        seen.append(loop._order_is_due)
        return learn(observations)

    monkeypatch.setattr(loop.algorithm, "learn", watched)
    assert loop.train() == 0
    assert seen == [False, False, True, False, True, False, True], "each is ordered in the iteration after it"
    assert [iteration for iteration, _ in ordered] == [2, 4, 6, 7]
    first, second = (list_checkpoints(Store(tmp_path).run(name)) for name in ("at-once", "later"))
    assert [each.iteration for each in first] == [each.iteration for each in second] == [2, 4, 6, 7]
    for one, other in zip(first, second, strict=True):
        assert_same_bits(one.path, other.path)
        assert one.manifest["reward"] == other.manifest["reward"]
    stalls = [record["stall_seconds"] > 0 for record in read_metrics(Store(tmp_path).run("later"))]
    assert stalls == seen


def test_a_checkpoint_that_is_ordered_late_names_the_adaptive_steps_of_its_own_iteration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next iteration, in which it is ordered as on a GPU, has moved the number before."""
    monkeypatch.setattr(CudaGraphFunction, "can_be_captured", True)
    name = f"{Climbing.__module__}:{Climbing.__qualname__}"
    loop = train(training(tmp_path, iterations=4, every=1, worlds=2, task=name), task=Climbing)
    assert loop.task.adapting is not None and loop.task.adapting.steps == {"kicks": 3.0}
    for checkpoint in list_checkpoints(Store(tmp_path).run("run")):
        worlds = torch.load(checkpoint.path / "rank-0.pt", weights_only=True)["worlds"]["state"]
        started, step = worlds["adaptive_numbers"][0].tolist()
        assert (started, step) == (checkpoint.iteration - 1, checkpoint.manifest["adaptive_steps"]["kicks"])
        assert step == checkpoint.iteration - 1


def test_a_chosen_checkpoint_is_gone_on_from(tmp_path: Path) -> None:
    train(training(tmp_path, iterations=4, every=2))
    chosen = {"MUSTER_CHECKPOINT": "00000002-e1", "MUSTER_JOB_EPOCH": "2"}
    assert runner(training(tmp_path, iterations=6, epoch=2) | chosen).state.progress.iteration == 2
    train(training(tmp_path, iterations=6, epoch=2) | chosen)
    newer = runner(training(tmp_path, iterations=6, epoch=3) | chosen)
    assert newer.state.progress.iteration == 6, "its own progress is newer"


def test_a_finished_run_has_all_its_files(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    train(training(tmp_path, iterations=3))
    output = capsys.readouterr().out
    run = Store(tmp_path).run("run")
    assert "iteration 3/3  reward " in output
    assert f"last checkpoint: {run.checkpoints / '00000003-e1'}" in output
    assert f"reward plot: {run.metrics / 'reward.png'}" in output
    assert (run.metrics / "reward.png").read_bytes().startswith(b"\x89PNG")
    events = EventAccumulator(str(run.metrics)).Reload()
    assert [(each.step, each.value) for each in events.Scalars("episode/reward")] == [
        (each["iteration"], pytest.approx(each["reward"])) for each in read_metrics(run) if each["reward"] is not None
    ], "TensorBoard, pointed at the run"
    result = json.loads((run.evaluations / "00000003-e1.json").read_text())
    assert result["episodes"] == 8 and result["max_length"] == 20 and 0 < result["mean_length"] <= 20
    record = read_metrics(run)[-1]
    requested = "env_steps reward episode_length steps_per_second collect_seconds learn_seconds iteration_seconds learning_rate kl"
    assert {*requested.split(), "value_loss", "surrogate_loss", "entropy", "action_std", "time"} <= record.keys()
    assert record["entropy"] == pytest.approx(1.4189 + torch.log(torch.tensor(record["action_std"])).item(), abs=0.02)


def test_a_save_that_the_volume_refuses_is_reported_and_training_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Store(tmp_path).run("run")
    run.checkpoints.mkdir(parents=True)
    obstacles = [run.checkpoints / ".00000002-e1.tmp", run.checkpoints / ".00000004-e2.tmp"]
    train_with_obstacle(training(tmp_path, iterations=3, every=1), obstacles[0])
    output = capsys.readouterr().out
    assert "warning: iteration 2 could not be saved (File exists: " in output and "training goes on" in output
    assert [c.iteration for c in list_checkpoints(run)] == [1, 3]
    ended = training(tmp_path, iterations=4, epoch=2)
    stop = StopRequest()
    monkeypatch.setattr("worker.learning.leaving.sleep", lambda _: setattr(stop, "requested", True))
    with pytest.raises(TrainingError, match="its last checkpoint could not be saved"):
        train_with_obstacle(ended, obstacles[1], stop)
    assert [c.iteration for c in list_checkpoints(run)] == [1, 3]
    obstacles[1].unlink()
    monkeypatch.setattr("worker.learning.leaving.sleep", lambda _: obstacles[1].unlink(missing_ok=True))
    train_with_obstacle(ended, obstacles[1])
    assert "its last checkpoint is not saved yet; trying again in 1 s" in capsys.readouterr().out
    assert [c.iteration for c in list_checkpoints(run)] == [1, 3, 4]


def train_with_obstacle(env: dict[str, str], obstacle: Path, stop: StopRequest | None = None) -> None:
    """Train with a file where a checkpoint's hidden directory is to be (put there after the sweep at the start)."""
    started = runner(env, stop=stop)
    obstacle.write_bytes(b"")
    started.train()


@pytest.mark.parametrize(
    ("command", "spec", "message", "code"),
    [
        ("train", None, "MUSTER_SPEC is not set", 2),
        ("train", {"train": {"task": "Cartpol"}}, "did you mean Cartpole?", 2),
        ("export", {"export": {"run": "nothing"}}, "run nothing has no checkpoint", 2),
    ],
)
def test_user_errors_are_one_line_and_reach_the_supervisor(
    tmp_path: Path, command: str, spec: dict | None, message: str, code: int
) -> None:
    errors = tmp_path / "error.json"
    supplied = {"TORCHELASTIC_ERROR_FILE": str(errors), "MUSTER_SPEC": json.dumps(spec) if spec else ""}
    env = {**training(tmp_path), **supplied}
    done = call_worker({"train": worker.train.main, "export": worker.export.main}[command], env)
    assert done.returncode == code
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("error: ") and message in line
    assert message in json.loads(errors.read_text())["message"]["message"]


def break_down() -> int:
    raise ValueError("a defect")


def diverge() -> int:
    raise TrainingError("iteration 3: 4 resets", "its physics")


def meet_nobody() -> int:
    raise GangError("rank 1 did not report")


@pytest.mark.parametrize(
    ("body", "kind", "cause"),
    [
        (break_down, "ValueError", ""),
        (diverge, "worker.settings.errors.TrainingError", "its physics"),
        (meet_nobody, None, ""),  # what another rank did is not this one's fault
    ],
)
def test_the_supervisor_receives_the_fault_that_another_attempt_would_meet(
    tmp_path: Path, body: Callable[[], int], kind: str | None, cause: str
) -> None:
    errors = tmp_path / "error.json"
    done = call_worker(body, {"TORCHELASTIC_ERROR_FILE": str(errors)})
    message = json.loads(errors.read_text())["message"]
    fault, line = message["extraInfo"]["fault"], body.__code__.co_firstlineno + 1
    assert done.returncode == 1 and int(message["extraInfo"]["timestamp"]) > 0
    if kind is None:
        assert fault is None
    else:
        assert (fault["type"], Path(fault["file"]).name, fault["line"]) == (kind, "test_runner.py", line)
        assert fault["cause"] == cause
    if kind == "ValueError":
        assert message["message"] == "ValueError: a defect" and "Traceback" in done.stderr
        assert "break_down" in message["extraInfo"]["py_callstack"]


def test_a_training_reports_its_phases_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    monkeypatch.setenv("MUSTER_PROGRESS_FD", str(write))
    monkeypatch.setenv("MUSTER_PICTURE", "0")  # its worlds have no shapes
    train(training(tmp_path, run="run", iterations=2))
    os.close(write)
    with os.fdopen(read) as messages:
        reported = [json.loads(line) for line in messages]
    phases = [Phase(each["phase"]) if "phase" in each else each.get("iteration") for each in reported]
    phases = [each for each in phases if each is not None]
    at_the_end = [Phase.SAVING, Phase.EVALUATING, Phase.WRITING]
    assert phases == [Phase.BUILDING, Phase.TRAINING, 1, 2, *at_the_end]
