"""A race through the real command: a trained racer drives laps, twice the same, with step logs; what is no race is refused."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Serving

SPEC = {
    "name": "car",
    "resources": {"cpus": 1, "memory": "2GiB"},
    "train": {"task": "Racer", "worlds": 32, "iterations": 4, "config": {"track": "oval"}},
    "checkpoint": {"every": 2},
}


@pytest.fixture(scope="module")
def raced(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Serving, str]]:
    """A server, and a run that was trained on it."""
    server = Serving(tmp_path_factory.mktemp("home"), "--cpus", "2")
    spec = server.home / "car.json"
    spec.write_text(json.dumps(SPEC))
    submitted = server.muster("submit", str(spec), "--json")
    assert submitted.returncode == 0, submitted.stderr
    detail = server.wait(json.loads(submitted.stdout)["jobId"], timeout=300)
    assert detail["status"] == "SUCCEEDED", detail["statusReason"]
    yield server, detail["run"]
    server.close()


def race(server: Serving, run: str, *options: str) -> dict[str, Any]:
    done = server.muster_process("evaluate", run, "--race", *options, "--json", timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


def test_a_race_has_the_same_lap_times_again_and_its_step_logs_are_copied(
    raced: tuple[Serving, str], tmp_path: Path
) -> None:
    server, run = raced
    options = ["--trials", "2", "--continuous", "--penalty", "5", "--track", "chicane", "--set", "race.seconds=30"]
    first = race(server, run, *options, "-o", str(tmp_path / "logs"))
    second = race(server, run, *options)
    assert first["race"] == second["race"] and first["name"] != second["name"]
    told = first["race"]
    assert told["rules"] == {
        **{"laps": 2, "continuous": True, "off_track_penalty": 5.0, "crash_penalty": 5.0, "max_resets": 100},
        **{"seconds": 30.0, "ranking": None},
    }
    assert told["track"] == ["chicane"] and [trial["trial"] for trial in told["trials"]] == [1, 2]
    logs = sorted((tmp_path / "logs").rglob("*.csv"))
    assert [log.name for log in logs] == ["0-iteration.csv", "1-iteration.csv"]
    for log, trial in zip(logs, told["trials"], strict=True):
        rows = log.read_text().splitlines()
        assert len(rows) == 2 + trial["steps"]  # columns, the start, a row a step
        assert trial["time"] == trial["steps"] / 15 + 5.0 * trial["off_tracks"]
        assert sum(",off_track," in row for row in rows) == trial["off_tracks"]


def test_a_race_is_printed_as_a_table_and_does_not_choose_the_best_checkpoint(raced: tuple[Serving, str]) -> None:
    server, run = raced
    before = server.client.get(f"/api/runs/{run}/checkpoints")
    done = server.muster_process(
        "evaluate", f"{run}@2", "--race", "--trials", "1", "--set", "race.seconds=2", timeout=300
    )
    assert done.returncode == 0 and "TRIAL       TIME COMPLETED STATUS" in done.stdout, done.stdout + done.stderr
    assert "checkpoint 00000002-e1" in done.stdout
    after = server.client.get(f"/api/runs/{run}/checkpoints")
    chosen = [[(each["name"], each["best"], each["evaluated"]) for each in listed] for listed in (before, after)]
    assert chosen[0] == chosen[1]
