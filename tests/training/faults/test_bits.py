"""A run that is killed, or stopped, and goes on ends with the same bits as one that is left alone: through the real command."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import MUSTER, PATIENCE, REPOSITORY, Serving, call_muster, wait_for
from tests.support.engines.training import same_bits
from tests.support.processes import gang_members, has_signal

CARTPOLE = ("job_specs/cartpole.yaml", "train.worlds=8", "checkpoint.every=4", "nodes=1")
ANT = ("job_specs/ant.yaml", "train.worlds=4", "checkpoint.every=2", "nodes=1", "train.ppo.steps=8")


long = pytest.mark.skipif(not os.environ.get("MUSTER_LONG"), reason="minutes: MUSTER_LONG=1, in make bits")


def options(spec: str, *changes: str) -> list[str]:
    return [spec, *(part for change in changes for part in ("--set", change))]


def verify(home: Path, at: int, iterations: int, *spec: str) -> subprocess.Popen[str]:
    """``muster verify-resume`` in the background."""
    return subprocess.Popen(
        [MUSTER, "verify-resume", *options(*spec), "--at", str(at), "--iterations", str(iterations), "--cpus", "4"],
        env={**os.environ, "MUSTER_HOME": str(home)},
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def proven(process: subprocess.Popen[str], iterations: int) -> tuple[str, str, int]:
    """Both runs, and the iteration at which the killed one went on, of a verification that found equal bits."""
    output, errors = process.communicate(timeout=900 * PATIENCE)
    assert process.returncode == 0, output + errors
    tensors = re.search(rf"^equal: (\d+) tensors, {iterations} iterations$", output, re.MULTILINE)
    assert tensors and int(tensors[1]) > 30, output
    result = re.search(
        r"^straight: (\S+)\nkilled: +(\S+), by SIGKILL .* resumed from iteration (\d+)$", output, re.MULTILINE
    )
    assert result, output
    return result[1], result[2], int(result[3])


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def verifying(home: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, subprocess.Popen[str]]]:
    """Verifications of one rank, at the same time, since the machine has two cores."""
    started = {"Cartpole": verify(home, 9, 91, *CARTPOLE)}
    if os.environ.get("MUSTER_LONG"):
        started["Ant"] = verify(tmp_path_factory.mktemp("ant"), 3, 2, *ANT)
    yield started
    for process in started.values():
        process.kill()


@pytest.fixture(scope="module")
def straight(home: Path, verifying: dict[str, subprocess.Popen[str]]) -> str:
    """A straight run of 100 iterations, after its killed twin was found to have the same bits."""
    one, two, resumed_from = proven(verifying["Cartpole"], 100)
    assert resumed_from in (0, 4, 8), "what it goes on from is the newest checkpoint that was durable"
    run = Store(home / "store").run(two)
    epochs = [json.loads(line) for line in (run.metrics / "metrics-e1.jsonl").read_text().splitlines()]
    assert epochs[-1]["iteration"] == 8, "it died before anything of iteration 9 was written"
    assert [record["iteration"] for record in read_metrics(run)] == list(range(1, 101))
    return one


def test_one_rank_killed_ends_with_the_same_bits(straight: str) -> None:
    assert straight.startswith("cartpole-straight-")


@long
def test_ants_killed_end_with_the_same_bits(verifying: dict[str, subprocess.Popen[str]]) -> None:
    proven(verifying["Ant"], 5)


# gangs of cart-poles are killed in test_torture.py and on every engine, too
@long
@pytest.mark.parametrize("spec", [ANT, CARTPOLE])
def test_a_gang_of_three_killed_ends_with_the_same_bits(tmp_path: Path, spec: tuple[str, ...]) -> None:
    _, killed, _ = proven(verify(tmp_path, 5, 2, *spec, "nodes=3", "train.worlds=5"), 7)
    (newest,) = (Store(tmp_path / "store").run(killed).checkpoints).glob("00000007-e2")
    assert json.loads((newest / "manifest.json").read_text())["shards"] == [[0, 5], [5, 5], [10, 5]]


def test_stopped_and_resumed_ends_with_the_same_bits(home: Path, straight: str) -> None:
    server = Serving(home, "--cpus", "4")
    try:
        submitted = server.muster("submit", *options(*CARTPOLE, "train.iterations=100"), "--json")
        job = server.detail(json.loads(submitted.stdout)["jobId"])
        run = Store(home / "store").run(job["run"])
        wait_for(lambda: len(read_metrics(run)) >= 2, 100, "the second iteration")
        [rank] = gang_members(server.home, "rank", 0)
        rank.strike(signal.SIGSTOP)  # until it has been asked to leave, so that it is not done before
        server.client.batch("TerminateJob", jobId=job["id"], reason="enough")
        wait_for(lambda: has_signal(rank.pid, "ShdPnd", signal.SIGTERM), 30, "the request to leave")
        rank.strike(signal.SIGCONT)
        server.wait(job["id"], timeout=100)
        reached = len(read_metrics(run))
        assert 2 <= reached < 100, "it was stopped on the way"
        resumed = json.loads(server.muster("resume", run.name, "--json").stdout)
        assert resumed["iteration"] == reached
        assert server.wait(resumed["jobId"], timeout=120)["status"] == "SUCCEEDED"
    finally:
        server.close()
    message = same_bits(home / "store", straight, run.name)
    assert re.fullmatch(r"equal: \d+ tensors, 100 iterations\n", message), message


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["job_specs/all-reduce.yaml", "--at", "3"], "verify-resume needs a job that trains; this is a command"),
        (["job_specs/cartpole.yaml", "--at", "0"], "--at 0: expected an iteration, from 1"),
        (["job_specs/cartpole.yaml", "--at", "7", "--iterations", "0"], "at least one iteration must follow --at 7"),
        (["nowhere.yaml", "--at", "3"], "nowhere.yaml: No such file"),
    ],
)
def test_misuse_of_the_command_is_one_line(tmp_path: Path, arguments: list[str], part: str) -> None:
    done = call_muster("verify-resume", *arguments, home=tmp_path / "home")
    assert done.returncode == 2 and part in done.stderr, done.stderr
    assert len(done.stderr.splitlines()) == 1 and not (tmp_path / "home").exists()
