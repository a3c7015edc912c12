"""A racer is trained briefly and races: twice the same, with step logs; in a league, where one of its races is driven again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from racer.store import leagues
from shared_store.volume.layout import Store
from tests.conftest import Serving

SMALL = ("train.iterations=30", "checkpoint.every=15", "train.config.track=oval", "train.worlds=64")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    with Serving(tmp_path_factory.mktemp("home"), "--cpus", "2") as server:
        yield server


def done(server: Serving, *arguments: str) -> str:
    """What a command prints."""
    ended = server.muster(*arguments)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


@pytest.fixture(scope="module")
def run(server: Serving) -> str:
    options = [f"--set={each}" for each in SMALL]
    job = json.loads(done(server, "submit", "job_specs/racer.yaml", "--json", *options))["jobId"]
    trained = server.wait(job, timeout=300)
    assert trained["status"] == "SUCCEEDED", trained["statusReason"]
    return str(trained["run"])


def test_a_race_has_the_same_lap_times_again_and_its_step_logs_are_copied(
    server: Serving, run: str, tmp_path: Path
) -> None:
    race = ("evaluate", run, "--race", "--trials", "2", "--continuous", "--penalty", "5", "--track", "chicane")
    options = (*race, "--set", "race.seconds=30", "--json")
    first = json.loads(done(server, *options, "-o", str(tmp_path / "logs")))
    second = json.loads(done(server, *options))
    assert first["race"] == second["race"] and first["name"] != second["name"]
    message = first["race"]
    assert message["rules"] == {
        **{"laps": 2, "continuous": True, "off_track_penalty": 5.0, "crash_penalty": 5.0, "max_resets": 100},
        **{"seconds": 30.0, "ranking": None},
    }
    assert message["track"] == ["chicane"] and [trial["trial"] for trial in message["trials"]] == [1, 2]
    logs = sorted((tmp_path / "logs").rglob("*.csv"))
    assert [log.name for log in logs] == ["0-iteration.csv", "1-iteration.csv"]
    for log, trial in zip(logs, message["trials"], strict=True):
        rows = log.read_text().splitlines()
        assert len(rows) == 2 + trial["steps"]  # columns, the start, a row a step
        assert trial["time"] == trial["steps"] / 15 + 5.0 * trial["off_tracks"]
        assert sum(",off_track," in row for row in rows) == trial["off_tracks"]


def test_a_race_is_printed_as_a_table_and_does_not_choose_the_best_checkpoint(server: Serving, run: str) -> None:
    def chosen() -> list[tuple[str, bool, bool]]:
        listed = server.client.get(f"/api/runs/{run}/checkpoints")
        return [(each["name"], each["best"], each["evaluated"]) for each in listed]

    before = chosen()
    message = done(server, "evaluate", f"{run}@15", "--race", "--trials", "1", "--set", "race.seconds=2")
    assert "TRIAL       TIME COMPLETED STATUS" in message and "checkpoint 00000015-e1" in message
    assert chosen() == before


def test_a_racer_is_registered_raced_ranked_and_verified(server: Serving, run: str) -> None:
    done(server, "export", run, "--episodes", "0")
    for _ in range(2):
        done(server, "models", "register", run, "--name", "fast", "--again")

    done(server, "league", "create", "cup", "--track", "oval", "--laps", "2", "--continuous")
    message = done(server, "league", "submit", "cup", "fast@1", "--as", "ada")
    assert "race: 2 laps of Racer on oval" in message
    assert message.splitlines()[-1].startswith("entry 1 of cup: ada with fast@1")
    later = json.loads(done(server, "league", "submit", "cup", "fast", "--as", "bob", "--json"))
    assert (later["entry"], later["model"], later["laps"]) == (2, "fast@2", 2)
    rows = json.loads(done(server, "league", "table", "cup", "--json"))
    cup = leagues.find(Store(server.home / "store"), "cup")
    for row in rows:
        trials = cup.entry(row["entry"])["race"]["trials"]
        whole = [each["time"] for each in trials if each["status"] == "lap_complete"]
        assert row["completed"] == len(whole) and row["time"] == (round(sum(whole), 3) if len(whole) == 2 else None)
        assert all(each["lap_time"] == each["steps"] / 15 for each in trials if each["lap_time"] is not None)
    assert (rows[0]["rank"], rows[0]["completed"]) == (1, 2), "30 iterations are enough for whole laps of the oval"
    order = [(row["rank"], row["entry"], row["time"]) for row in rows]
    assert order == [(1, 1, rows[0]["time"]), (2, 2, rows[0]["time"])], "the same policy: the earlier entry is ahead"

    verified = done(server, "league", "verify", "cup", "1", "--rerun")
    assert verified.splitlines() == ["entry 1: every lap is the same, bit for bit"]
    path = cup.path / "entries" / "2" / "entry.json"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes().replace(b'"racer": "bob"', b'"racer": "eve"'))
    altered = server.muster("league", "verify", "cup")
    assert altered.returncode == 1 and "entry 2: the content of entry.json was altered" in altered.stdout
    table = json.loads(done(server, "league", "table", "cup", "--json"))
    assert [row["status"] for row in table if row["entry"] == 2] == ["altered"]
