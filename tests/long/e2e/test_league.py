"""A racer is trained briefly, its policy is entered in a league twice, and one of the races is driven again."""

from __future__ import annotations

import json

from shared_store import leagues
from shared_store.layout import Store
from tests.conftest import Serving

SMALL = ("train.iterations=30", "checkpoint.every=30", "train.config.track=oval", "train.worlds=64")


def test_a_racer_is_trained_registered_raced_ranked_and_verified(server: Serving) -> None:
    def done(*arguments: str) -> str:
        ended = server.muster_process(*arguments, timeout=300)
        assert ended.returncode == 0, ended.stdout + ended.stderr
        return ended.stdout

    options = [f"--set={each}" for each in SMALL]
    job = json.loads(done("submit", "job_specs/racer.yaml", "--json", *options))["jobId"]
    trained = server.wait(job, timeout=300)
    assert trained["status"] == "SUCCEEDED", trained["statusReason"]
    done("export", trained["run"], "--episodes", "0")
    for _ in range(2):
        done("models", "register", trained["run"], "--name", "fast", "--again")

    done("league", "create", "cup", "--track", "oval", "--laps", "2", "--continuous")
    told = done("league", "submit", "cup", "fast@1", "--as", "ada")
    assert "race: 2 laps of Racer on oval" in told and told.splitlines()[-1].startswith(
        "entry 1 of cup: ada with fast@1"
    )
    later = json.loads(done("league", "submit", "cup", "fast", "--as", "bob", "--json"))
    assert (later["entry"], later["model"], later["laps"]) == (2, "fast@2", 2)
    rows = json.loads(done("league", "table", "cup", "--json"))
    cup = leagues.find(Store(server.home / "store"), "cup")
    for row in rows:
        trials = cup.entry(row["entry"])["race"]["trials"]
        whole = [each["time"] for each in trials if each["status"] == "lap_complete"]
        assert row["completed"] == len(whole) and row["time"] == (round(sum(whole), 3) if len(whole) == 2 else None)
        assert all(each["lap_time"] == each["steps"] / 15 for each in trials if each["lap_time"] is not None)
    assert (rows[0]["rank"], rows[0]["completed"]) == (1, 2), "30 iterations are enough for whole laps of the oval"
    order = [(row["rank"], row["entry"], row["time"]) for row in rows]
    assert order == [(1, 1, rows[0]["time"]), (2, 2, rows[0]["time"])], "the same policy: the earlier entry is ahead"

    assert done("league", "verify", "cup", "1", "--rerun").splitlines() == [
        "entry 1: every lap is the same, bit for bit"
    ]
    path = cup.path / "entries" / "2" / "entry.json"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes().replace(b'"racer": "bob"', b'"racer": "eve"'))
    altered = server.muster("league", "verify", "cup")
    assert altered.returncode == 1 and "entry 2: the content of entry.json was altered" in altered.stdout
    assert [row["status"] for row in json.loads(done("league", "table", "cup", "--json")) if row["entry"] == 2] == [
        "altered"
    ]
