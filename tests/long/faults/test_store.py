"""The store under stress: full, read-only, slow, deleted. One clear line each; the last checkpoint safe; training goes on or stops."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Store
from tests.conftest import PATIENCE, Serving, wait_for
from tests.support.faults.full_disk import fill
from tests.support.processes import end_all, gang_members
from tests.support.worker.cartpole import raw_iterations, submit, wait_for_iteration


def mount(*arguments: str) -> None:
    done = subprocess.run(["mount", *arguments], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"this machine lets nobody mount: {done.stderr.strip()}")


@pytest.fixture
def volume(tmp_path: Path) -> Iterator[Path]:
    """A volume of its own of 12 MiB, with ext4 where loop devices are allowed, else in memory."""
    target, image = tmp_path / "volume", tmp_path / "image"
    target.mkdir()
    subprocess.run(["truncate", "-s", "24M", str(image)], check=True)
    made = shutil.which("mkfs.ext4") and subprocess.run(["mkfs.ext4", "-q", "-m", "0", str(image)]).returncode == 0
    if not made or subprocess.run(["mount", "-o", "loop", str(image), str(target)], capture_output=True).returncode:
        mount("-t", "tmpfs", "-o", "size=12m", "tmpfs", str(target))
    yield target
    subprocess.run(["umount", "-l", str(target)], check=False)


@pytest.fixture
def on_volume(tmp_path: Path, volume: Path) -> Iterator[Serving]:
    server = Serving(tmp_path / "home", "--cpus", "4", "--store", str(volume / "store"))
    yield server
    server.close()  # first: it would start again what is killed
    end_all(volume)


def test_a_full_disk_costs_saves_and_nothing_else(on_volume: Serving, volume: Path) -> None:
    job = submit(on_volume, "train.iterations=100000", "nodes=1", "checkpoint.every=10")
    run = Store(volume / "store").run(job["run"])
    wait_for(lambda: len(list_checkpoints(run)) >= 2, 180, "two checkpoints")
    filler = fill(volume)
    last = list_checkpoints(run)[-1]
    progress = on_volume.client.get(f"/api/jobs/{job['id']}")
    wait_for(lambda: on_volume.muster("checkpoint", job["id"]).returncode == 1, 30, "a save that is refused")
    message = on_volume.muster("checkpoint", job["id"])
    assert "could not be saved (No space left on device: " in message.stdout and "training goes on" in message.stdout
    list_checkpoints(run)[-1].verify()
    assert list_checkpoints(run)[-1].iteration >= last.iteration
    assert on_volume.detail(job["id"])["status"] == "RUNNING" == progress["status"]
    filler.unlink()
    wait_for(lambda: on_volume.muster("checkpoint", job["id"]).returncode == 0, 30, "a save once there is room")
    stopped = on_volume.muster("stop", job["id"])
    assert stopped.returncode == 0 and len(on_volume.detail(job["id"])["attempts"]) == 1
    list_checkpoints(run)[-1].verify()
    assert not [name for name in os.listdir(run.checkpoints) if name.endswith(".trash")]


def test_a_store_that_turns_read_only_keeps_the_last_checkpoint(on_volume: Serving, volume: Path) -> None:
    job = submit(on_volume, "train.iterations=100000", "nodes=1", "checkpoint.every=10")
    run = Store(volume / "store").run(job["run"])
    wait_for(lambda: len(list_checkpoints(run)) >= 2, 180, "two checkpoints")
    # an error of the device makes ext4 do this to itself; a busy volume can't be remounted in the ordinary way
    aborted = subprocess.run(["mount", "-o", "remount,abort", str(volume)], capture_output=True, text=True)
    if aborted.returncode:
        pytest.skip(f"a busy volume can't be made read-only here: {aborted.stderr.strip()}")
    kept = [checkpoint.name for checkpoint in list_checkpoints(run)]
    message = on_volume.muster("checkpoint", job["id"])
    assert (
        message.returncode == 1 and "could not be saved" in message.stdout and "training goes on" in message.stdout
    ), message.stdout
    assert on_volume.detail(job["id"])["status"] == "RUNNING"
    assert [checkpoint.name for checkpoint in list_checkpoints(run)] == kept
    list_checkpoints(run)[-1].verify()
    assert on_volume.muster("stop", job["id"]).returncode == 0


def test_slow_writes_do_not_hold_up_training(server: Serving) -> None:
    job = submit(server, "train.iterations=100000", "nodes=1", "checkpoint.every=100000")
    wait_for_iteration(server, job["run"], 5)
    assert server.muster("checkpoint", job["id"]).returncode == 0
    [writer] = gang_members(server.home, "writer")
    writer.strike(signal.SIGSTOP)  # a volume that takes for ever, as the writer sees it
    answers: list[str] = []
    asking = threading.Thread(target=lambda: answers.append(server.muster_process("checkpoint", job["id"]).stdout))
    asking.start()
    reached = raw_iterations(server, job["run"])[-1]
    wait_for(lambda: raw_iterations(server, job["run"])[-1] > reached + 30, 30, "progress while the writer waits")
    assert not answers, "it was acknowledged before it was durable"
    writer.strike(signal.SIGCONT)
    asking.join(30 * PATIENCE)
    assert answers and answers[0].startswith("checkpoint ")
    writer.strike(signal.SIGKILL)
    died = server.muster("checkpoint", job["id"]).stdout
    assert died.startswith("checkpoint "), "a writer that died is replaced"
    assert server.muster("stop", job["id"]).returncode == 0


def test_a_run_that_is_deleted_while_it_trains_does_not_come_back_in_part(server: Serving) -> None:
    job = submit(server, "train.iterations=100000", "nodes=1", "checkpoint.every=10")
    wait_for_iteration(server, job["run"], 12)
    run = Store(server.home / "store").run(job["run"])
    while run.path.exists():  # what trains may write into it meanwhile
        shutil.rmtree(run.path, ignore_errors=True)
    message = server.muster("checkpoint", job["id"])
    assert message.returncode == 1 and "could not be saved (No such file or directory: " in message.stdout
    assert server.muster("stop", job["id"]).returncode == 0
    detail = server.detail(job["id"])
    assert detail["status"] == "FAILED"
    assert not (run.path / "run.json").exists() and list_checkpoints(run) == []


def test_a_node_that_is_asked_to_leave_takes_the_gang_along_and_loses_no_iteration(server: Serving) -> None:
    """Preemption: SIGTERM to one node; all agree on an iteration, save, leave with 75, and go on from there."""
    job = submit(server, "train.iterations=100000", "checkpoint.every=100000")
    wait_for_iteration(server, job["run"], 5)
    wait_for(lambda: _age(server, job["id"]) > 10.5, 30, "an attempt that is old enough to be worth a requeue")
    [supervisor] = gang_members(server.home, "supervisor", 1)
    supervisor.strike(signal.SIGTERM)
    wait_for(lambda: len(server.detail(job["id"])["attempts"]) == 2, 60, "the second attempt")
    first = server.detail(job["id"])["attempts"][0]
    assert first["ending"] == "requeue" and not first["spent"], first
    assert [node["exitCode"] for node in first["nodes"]] == [75, 75]
    left = raw_iterations(server, job["run"])[-1]
    wait_for_iteration(server, job["run"], left + 3)
    assert server.muster("stop", job["id"]).returncode == 0
    iterations = raw_iterations(server, job["run"])
    assert iterations == list(range(1, len(iterations) + 1)), "an iteration was lost or done twice"


def _age(server: Serving, job: str) -> float:
    return time.time() - server.detail(job)["startedAt"] / 1000
