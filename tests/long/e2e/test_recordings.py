"""A training is recorded as it runs, its checkpoint afterwards, and a picture of it is made: all through the command."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import onnx
from mcap.reader import make_reader
from PIL import Image

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.layout import Store
from tests.conftest import MUSTER, Serving, call_muster, wait_for
from tests.support.processes import kill_rank

SMALL = {
    "nodes": 1,
    "train.worlds": 8,
    "train.iterations": 1000000,
    "train.config": {"episode_seconds": 0.5},
    "checkpoint.every": 50,
    "train.ppo.hidden_sizes": [8],
    "train.ppo.steps": 8,
}
"""Episodes of 30 steps."""


def episodes(path: Path) -> list[dict[str, str]]:
    with path.open("rb") as file:
        return [each.metadata for each in make_reader(file).iter_metadata() if each.name == "episode"]


def attachments(path: Path) -> dict[str, bytes]:
    with path.open("rb") as file:
        return {each.name: each.data for each in make_reader(file).iter_attachments()}


def test_a_training_and_its_checkpoint_are_recorded_and_rendered(server: Serving, tmp_path: Path) -> None:
    options = [part for key, value in SMALL.items() for part in ("--set", f"{key}={json.dumps(value)}")]
    job = json.loads(server.muster("submit", "job_specs/cartpole.yaml", "--json", *options).stdout)["jobId"]
    run = Store(server.home / "store").run(server.detail(job)["run"])
    wait_for(lambda: list_checkpoints(run), timeout=300, what="the first checkpoint")

    live = tmp_path / "live.mcap"
    done = server.muster_process("record", job, "-o", str(live), "--worlds", "2", "--episodes", "2", timeout=180)
    assert done.returncode == 0, done.stderr
    waiting, loading, *_ = [line for line in done.stderr.splitlines() if "Warp" not in line]
    assert (
        waiting == f"waiting for the training of run {run.name} to answer …"
        and loading == "loading Cartpole in 2 worlds …"
    )
    known = episodes(live)
    assert {each["world"] for each in known} == {"0", "1"} and {each["job"] for each in known} == {job}
    assert all(each["length"] == "30" for each in known if each["complete"] == "true" and each["end"] == "time_out")
    wait_for(lambda: not list(run.telemetry.iterdir()), what="the training sees that nobody reads any more")
    assert server.detail(job)["status"] == "RUNNING"
    with live.open("rb") as file:
        assert any(b"iteration" in message.data for _, _, message in make_reader(file).iter_messages("/rosout"))

    stopped = server.muster_process("stop", job, timeout=180)
    assert stopped.returncode == 0, stopped.stderr
    file = tmp_path / "policy.mcap"
    done = server.muster_process(
        "record", f"{run.name}@latest", "-o", str(file), "--worlds", "2", "--episodes", "1", timeout=180
    )
    assert done.returncode == 0, done.stderr + done.stdout
    assert "loading Cartpole in 2 worlds …" in done.stderr.splitlines() and "loading" not in done.stdout
    facts = episodes(file)
    assert [(each["world"], each["complete"], each["run"]) for each in facts] == [
        (world, "true", run.name) for world in sorted(each["world"] for each in facts)
    ]
    [used] = [each for each in list_checkpoints(run) if each.name == facts[0]["checkpoint"]]
    reported = attachments(file)
    contract, model = json.loads(reported["contract.json"]), onnx.load_from_string(reported["policy.onnx"])
    assert contract == used.manifest["contract"] and json.loads(reported["job.json"])["train"]["task"] == "Cartpole"
    assert {each.key: each.value for each in model.metadata_props}["run_path"] == f"{run.name}/{used.name}"
    assert set(reported) == {"contract.json", "policy.onnx", "job.json", "robot.xml", "channels.json"}
    while_training = attachments(live)
    assert json.loads(while_training["contract.json"]) == contract and "policy.onnx" not in while_training
    held = {each.iteration: each.manifest["files"]["learner.pt"]["sha256"] for each in list_checkpoints(run)}
    assert all(held[int(each["iteration"])] == each["policy_sha256"] for each in facts)

    picture = tmp_path / "policy.png"
    size = ["--size", "96x64", "--worlds", "1", "--seconds", "0.5"]
    done = server.muster_process("render", job, "-o", str(picture), *size, timeout=300)
    assert done.returncode == 0, done.stderr + done.stdout
    assert Image.open(picture).size == (3 * 96 + 4, 2 * 64 + 2)
    assert not list(run.recordings.iterdir()), "what was brought to the user is not kept twice"

    iterations = sorted(held)
    (tmp_path / "cut.mcap.partial").touch()
    drawn = tmp_path / "curves.png"
    drawn.touch()
    kept = file.read_bytes(), picture.read_bytes()
    refused = {
        ("record", run.name, "-o", str(file)): f"-o {file}: it exists; --overwrite replaces it",
        ("record", run.name, "-o", str(tmp_path / "cut.mcap")): "cut.mcap.partial exists, a recording",
        ("render", run.name, "-o", str(picture)): f"-o {picture}: it exists; --overwrite replaces it",
        ("compare", run.name, "other", "-o", str(drawn)): f"-o {drawn}: it exists; --overwrite replaces it",
        ("record", "nothing", "-o", "x.mcap"): "run nothing does not exist",
        ("record", f"{run.name}@7", "-o", "x.mcap"): f"no checkpoint of iteration 7; available: {iterations[0]}",
        ("record", run.name, "-o", str(tmp_path)): "it is a directory; name a file in it",
        ("record", run.name, "-o", str(tmp_path / "no" / "x.mcap")): f"{tmp_path / 'no'} is not a directory",
        ("record", run.name, "-o", "x.bag"): "unknown ending; use one of .mcap",
        ("record", run.name): "-o is missing: muster record",
        ("record", "--recover", str(tmp_path / "x.mcap.partial")): "there is no such file",
        ("render", run.name, "-o", "x.avi"): "unknown ending; use one of .gif, .mp4, .png",
        ("render", run.name, "-o", "x.mp4", "--size", "161x121"): "each side is from 64 to 4096 pixels, and even",
        ("render", run.name, "-o", "x.gif", "--size", "big"): "expected WIDTHxHEIGHT, such as 640x360",
    }
    for arguments, words in refused.items():
        recovers = "--recover" in arguments  # in a process of the command's, whose words are not caught here
        done = server.muster_process(*arguments) if recovers else call_muster(*arguments, home=server.home)
        assert done.returncode in (1, 2) and words in done.stderr, (arguments, done.stderr)
        assert len(done.stderr.strip().splitlines()) == 1
    assert kept == (file.read_bytes(), picture.read_bytes()) and not drawn.stat().st_size
    done = server.muster_process(
        "render", job, "-o", str(picture), "--overwrite", *size[:-2], "--seconds", "0.2", timeout=300
    )
    assert done.returncode == 0 and picture.read_bytes() != kept[1], done.stderr


def test_a_recording_of_a_training_that_dies_goes_on_with_its_next_attempt(server: Serving, tmp_path: Path) -> None:
    options = [part for key, value in SMALL.items() for part in ("--set", f"{key}={json.dumps(value)}")]
    job = json.loads(server.muster("submit", "job_specs/cartpole.yaml", "--json", *options).stdout)["jobId"]
    run = Store(server.home / "store").run(server.detail(job)["run"])
    wait_for(lambda: list_checkpoints(run), timeout=300, what="the first checkpoint")
    file = tmp_path / "dies.mcap"
    command = [str(MUSTER), "record", job, "-o", str(file), "--worlds", "1", "--episodes", "400"]
    recording = subprocess.Popen(
        command,
        env={**os.environ, "MUSTER_HOME": str(server.home)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    partial = file.with_name("dies.mcap.partial")
    wait_for(lambda: partial.exists() and partial.stat().st_size > 60_000, timeout=120, what="some steps")
    kill_rank(job, 0)
    wait_for(
        lambda: server.detail(job)["attempts"] and server.detail(job)["status"] == "RUNNING",
        timeout=120,
        what="attempt 2",
    )
    _, err = recording.communicate(timeout=400)
    assert recording.returncode == 0, err
    assert "died; waiting for its next attempt on this machine" in err
    known = episodes(file)
    assert len(known) >= 400 and {each["run"] for each in known} == {run.name}
    assert all(each["length"] == "30" for each in known if each["complete"] == "true" and each["end"] == "time_out")
    with file.open("rb") as opened:
        lines = [message.data for _, _, message in make_reader(opened).iter_messages("/rosout")]
    assert sum(b"the training died; the recording goes on with its next attempt" in line for line in lines) == 1
    assert server.muster_process("stop", job, timeout=180).returncode == 0
