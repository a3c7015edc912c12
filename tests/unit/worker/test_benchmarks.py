"""A table that is made on a loaded machine says so, or is not made; tables of one machine do not contradict one another."""

from __future__ import annotations

import os
import signal
import subprocess
import time

import pytest
import warp as wp

from benchmarks import load, racer
from benchmarks.processor import contradictions
from benchmarks.tasks import LOADED

BUSY = "while :; do :; done"


def test_a_machine_on_which_others_work_is_refused_or_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load, "WATCHED", 0.5)
    started = f"timeout 60 sh -c '{BUSY}' >/dev/null & echo $!"  # its parent ends: it is no child of this process
    other = int(subprocess.run(["sh", "-c", started], stdout=subprocess.PIPE, text=True, check=True).stdout)
    try:
        with pytest.raises(SystemExit, match=r"the machine is loaded: other processes used \d+ % .*--loaded-anyway"):
            load.Watch(loaded_anyway=False)
        row = load.Watch(loaded_anyway=True).start
    finally:
        os.kill(other, signal.SIGTERM)
    assert row["others"] > load.LIMIT
    assert load.told([row]).startswith("**The machine was loaded.** Other processes used at most ")
    assert "loaded" not in load.told([{"others": 0.01, "load_average": 0.2}])


def test_processes_started_by_a_benchmark_do_not_count_as_load() -> None:
    before = load.own_seconds()
    child = subprocess.Popen(["sh", "-c", f"sh -c '{BUSY}' & wait"], start_new_session=True)
    try:
        deadline = time.monotonic() + 60
        while load.own_seconds() < before + 0.3:  # while it runs, and its child's child
            assert time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        os.killpg(child.pid, signal.SIGKILL)
        child.wait()


def test_a_training_that_took_longer_than_its_rate_says_is_a_contradiction() -> None:
    rates = [{"task": "Cartpole", "worlds": 64, "train": 64_740.0, "stock": 30_140.0}]
    curve = [[9.2, 153_600, 27.3, 300.0]]
    ours = {"task": "Cartpole", "worlds": 64, "seconds": 9.2, "curve": curve}
    theirs = {**ours, "stock": True, "seconds": 5.3}
    (line,) = contradictions(rates, [ours, theirs, {**ours, "worlds": 128}])
    assert line == "Cartpole with 64 worlds by Muster: 153,600 steps took 9.2 s, its rate says 2.4 s"


def test_compile_times_are_read_from_what_warp_says(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wp.config, "log_level", wp.LOG_INFO)  # a training in this process may have silenced it

    @wp.kernel(module="unique")
    def fill(values: wp.array[wp.float32]):
        values[wp.tid()] = 2.0

    values = wp.zeros(3, dtype=wp.float32, device="cpu")
    started = time.perf_counter()
    wp.launch(fill, dim=3, inputs=[values], device="cpu")
    took = time.perf_counter() - started
    [(module, milliseconds)] = LOADED.findall(capfd.readouterr().out)
    assert "fill" in module and 0.0 < float(milliseconds) <= 1000.0 * took and values.numpy().tolist() == [2.0] * 3


def test_the_racers_table_tells_when_a_car_first_drove_a_lap_and_how_fast_it_is_in_the_end() -> None:
    at = {"seconds": 2.0, "cpu_seconds": 3.0, "env_steps": 400_000, "iteration": 4}
    curve = [{**at, "seconds": 1.0, "laps": 0, "progress": None}, {**at, "laps": 2, "progress": 50.0}]
    early = {**at, "share": 0.5, "lap_times": {"oval": [9.0], "chicane": []}}
    last = {**at, "seconds": 7.0, "share": 0.75, "lap_times": {"oval": [9.0, 10.0], "chicane": [20.0]}}
    row = {
        **{"task": "Racer", "cuda": False, "cores": 2, "worlds": 128, "wanted": 0.5, "judged_worlds": 4},
        **{"training_rate": 1000.0, "simulation_rate": 150_000.0, "curve": curve, "judged": [early, last]},
        "done": early,
    }
    said = racer.table([row])
    assert "| 128 | 2.0 s (3 s of processors), 0.40 M steps | 2.0 s (3 s" in said
    assert "| 75.0 % | 1,000 steps/s | 150,000 cars · steps/s | 10,000 |" in said  # 150,000 / 15
    assert "| oval | 2 of 2 | 9.00 | 9.50 |" in said and "| chicane | 1 of 2 | 20.00 | 20.00 |" in said
    assert "| no | 7.0 s" in racer.table([{**row, "done": None}])
