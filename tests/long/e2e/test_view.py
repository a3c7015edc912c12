"""The live view through the command: a training as it runs, which is killed meanwhile, and its policy afterwards; in a real browser."""

from __future__ import annotations

import ipaddress
import json
import os
import re
import signal
import subprocess
import urllib.parse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.files import read_json
from shared_store.volume.layout import Run, Store
from tests.conftest import MUSTER, Serving, wait_for
from tests.long.e2e.test_recordings import SMALL as RECORDED
from tests.support.browser import empty_page, picture
from worker.telemetry.page import need_rerun

SMALL = {**RECORDED, "checkpoint.every": 10, "retry.attempts": 3}


class View:
    """A ``muster view`` that runs."""

    def __init__(self, server: Serving, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [MUSTER, "view", *arguments],
            env={**os.environ, "MUSTER_HOME": str(server.home), "COLUMNS": "300"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.output: list[str] = []
        self.url = self.until("the view is at ").split()[-1]

    def until(self, words: str) -> str:
        """The next line that has these words."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.output.append(line)
            if words in line:
                return line
        raise AssertionError(f"it ended without {words!r}: {self.output}")

    @property
    def below(self) -> list[psutil.Process]:
        return psutil.Process(self.process.pid).children(recursive=True)

    @property
    def stream(self) -> str:
        """Of Rerun's server itself, for its own clients (gRPC); the page relays what a browser asks (gRPC-web)."""
        (server,) = [each.cmdline() for each in self.below if each.name() == "rerun"]
        address, port = (server[server.index(option) + 1] for option in ("--bind", "--port"))
        return f"rerun+http://{address}:{port}/proxy"

    def interrupt(self) -> int:
        """Ctrl-C, as a terminal sends it to all of them; returns the exit code."""
        for each in self.below:
            each.send_signal(signal.SIGINT)
        assert self.process.stdout is not None
        self.output += self.process.stdout.readlines()
        return self.process.wait()

    def close(self) -> None:
        for each in [*self.below, psutil.Process(self.process.pid)] if self.process.poll() is None else []:
            each.kill()
        self.process.wait()


def saved(view: View, file: Path) -> dict[str, Any]:
    """What a client of Rerun's server gets, by entity: tables with the rows of all chunks, after some seconds."""
    import pyarrow as pa
    from rerun.chunk import RrdReader

    client = subprocess.Popen(
        [need_rerun(), view.stream, "--save", file, "--bind", "127.0.0.1", "--port", "auto"],
        stderr=subprocess.DEVNULL,
    )
    size = wait_for(lambda: file.exists() and file.stat().st_size, 60, "the stream")
    for more in (200_000, 150_000):  # what was there already, then some frames of 3 kB
        size += more
        wait_for(lambda size=size: file.stat().st_size > size, 60, "some frames of the stream")
        size = file.stat().st_size
    client.kill()  # what it has written can be read
    client.wait()
    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(file).stream().to_chunks():
        found.setdefault(chunk.entity_path, []).append(pa.Table.from_batches([chunk.to_record_batch()]))
    return {name: pa.concat_tables(tables, promote_options="default") for name, tables in found.items()}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    server = Serving(tmp_path_factory.mktemp("view"), "--cpus", "4")
    yield server
    server.close()


@pytest.fixture(scope="module")
def job(server: Serving) -> str:
    options = [part for key, value in SMALL.items() for part in ("--set", f"{key}={json.dumps(value)}")]
    job: str = json.loads(server.muster("submit", "job_specs/cartpole.yaml", "--json", *options).stdout)["jobId"]
    wait_for(lambda: list_checkpoints(run_of(server, job)), timeout=300, what="the first checkpoint")
    return job


def run_of(server: Serving, job: str) -> Run:
    return Store(server.home / "store").run(server.detail(job)["run"])


@pytest.fixture(scope="module")
def view(server: Serving, job: str) -> Iterator[View]:
    view = View(server, job, "--worlds", "2")
    yield view
    view.close()


def rank_of(run: Run) -> psutil.Process:
    reported = wait_for(lambda: read_json(run.telemetry / "tap.json"), 60, "the training's answer")
    return psutil.Process(reported["process"])


def test_frames_curve_and_log_of_a_training_arrive_at_20_hz_at_most(view: View, job: str, tmp_path: Path) -> None:
    tables = saved(view, tmp_path / "view.rrd")
    frames = np.unique(tables["/tf"]["time"].to_numpy().astype(np.int64))
    assert len(frames) > 5 and (len(frames) - 1) / (np.ptp(frames) / 1e9) < 20.5
    assert tables["/tf"].num_rows == 5 * len(frames)  # cart and pole of two worlds, and what the eye follows
    assert np.all(np.diff(np.unique(tables["/tf"]["step"].to_numpy())) > 0)
    iterations = tables["/return/mean"]["iteration"].to_pylist()
    assert len(iterations) > 3 and sorted(iterations) == list(range(min(iterations), max(iterations) + 1))
    lines = [each[0] for each in tables["/log"]["TextLog:text"].to_pylist()]
    assert any(re.match(r"\d\d:\d\d:\d\d  rank 0  iteration ", line) for line in lines)
    shapes = {f"/worlds/world_{world}/{link}" for world in (0, 1) for link in ("cart", "pole", "fixed")}
    assert shapes <= set(tables)


def test_only_loopback_is_listened_on_and_no_rank_has_rerun_in_its_memory(
    view: View, server: Serving, job: str
) -> None:
    listening = [
        each.laddr.ip
        for process in view.below
        for each in process.net_connections("inet")
        if each.status == psutil.CONN_LISTEN
    ]
    assert len(listening) >= 3 and all(ipaddress.ip_address(each).is_loopback for each in listening)
    rank = rank_of(run_of(server, job))
    assert any("worker.train" in part for part in rank.cmdline())
    assert not [each.path for each in rank.memory_maps() if "rerun" in each.path]


def test_a_training_has_one_reader_and_a_second_one_is_refused_in_one_line(
    view: View, server: Serving, job: str
) -> None:
    done = server.muster_process("view", job)
    (line,) = done.stderr.strip().splitlines()
    assert done.returncode == 1 and "is being recorded or viewed already, by process" in line


def test_a_browser_shows_the_training_moving_and_asks_no_other_machine(view: View) -> None:
    requested: set[str] = set()
    with empty_page() as page:
        page.on("request", lambda request: requested.add(request.url))
        page.goto(view.url, timeout=120_000)

        def worlds() -> np.ndarray:
            return picture(page)[40:220, 10:360].astype(int)

        def is_drawn() -> bool:
            blue = np.abs(worlds() - (110, 150, 215)).max(-1) < 60  # the carts
            return bool(blue.sum() > 20)

        wait_for(is_drawn, 120, "the carts on the screen")
        first = worlds()
        wait_for(lambda: (np.abs(worlds() - first).max(-1) > 40).sum() > 20, 120, "another frame")
    hosts = {urllib.parse.urlsplit(url).hostname or "" for url in requested if not url.startswith(("data:", "blob:"))}
    assert hosts and all(ipaddress.ip_address(host).is_loopback for host in hosts), hosts


def test_the_view_goes_on_with_the_next_attempt_and_says_where_its_server_is_gone(
    view: View, server: Serving, job: str
) -> None:
    rank_of(run_of(server, job)).kill()
    view.until("the training stopped; the view goes on with its next attempt")
    view.until("the training goes on")
    (rerun,) = [each for each in view.below if each.name() == "rerun"]
    rerun.kill()
    line = view.until("muster: the viewer's server ended (signal 9)")
    assert "start the view again" in line
    assert view.process.wait() == 1 and not view.process.stdout.read()
    assert not (run_of(server, job).telemetry / "request.json").exists()


def test_a_checkpoint_s_policy_acts_until_its_episodes_are_over(server: Serving, job: str, tmp_path: Path) -> None:
    server.muster("stop", job)
    run = run_of(server, job)
    done = server.muster_process("view", f"{run.name}@best", "--worlds", "2", "--episodes", "2", timeout=180)
    assert done.returncode == 0, done.stderr
    found = re.search(r"viewed: (\d+) frames", done.stdout)
    assert found and int(found[1]) > 2
    view = View(server, run.name, "--worlds", "1")
    try:
        tables = saved(view, tmp_path / "policy.rrd")
        assert view.interrupt() == 0 and not [line for line in view.output if "Traceback" in line]
    finally:
        view.close()
    lines = [each[0] for each in tables["/log"]["TextLog:text"].to_pylist()]
    assert any(f"of run {run.name}: 1 world," in line for line in lines)
    assert any("world 0: episode 0 ended by" in line for line in lines)


def test_what_can_t_be_viewed_is_refused_in_one_line(server: Serving, job: str, tmp_path: Path) -> None:
    run = run_of(server, job)
    (tmp_path / "text.mcap").write_text("no recording")
    (tmp_path / "text.rrd").write_text("no recording")
    refused = {
        ("view", "nothing"): "run nothing does not exist",
        ("view", "nothing.mcap"): "nothing.mcap: no such file",
        ("view", f"{run.name}@7"): "no checkpoint of iteration 7; available: ",
        ("view", run.name, "--memory", "much"): "expected a number with MB or GB",
        ("view", str(tmp_path / "text.mcap")): "it does not begin as an MCAP file does",
        ("view", str(tmp_path / "text.rrd")): "it does not begin as an .rrd file does",
        ("view", str(tmp_path / "text.rrd"), "--episodes", "1"): "only the policy of a RUN takes it",
    }
    for arguments, words in refused.items():
        done = server.muster_process(*arguments)
        assert done.returncode in (1, 2) and words in done.stderr, (arguments, done.stderr)
        assert len(done.stderr.strip().splitlines()) == 1, done.stderr
