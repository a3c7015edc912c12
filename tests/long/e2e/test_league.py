"""A racer is trained briefly, two of its checkpoints race in a league, and the race of one is driven again."""

from __future__ import annotations

import json

from shared_store import leagues
from shared_store.layout import Store
from tests.conftest import Serving

SMALL = ("train.iterations=30", "checkpoint.every=15", "train.config.track=oval", "train.worlds=64")


def test_two_checkpoints_of_a_racer_race_in_a_league(server: Serving) -> None:
    def done(*arguments: str) -> str:
        ended = server.muster(*arguments, timeout=300)
        assert ended.returncode == 0, ended.stdout + ended.stderr
        return ended.stdout

    options = [f"--set={each}" for each in SMALL]
    job = json.loads(done("submit", "job_specs/racer.yaml", "--json", *options))["jobId"]
    trained = server.wait(job, timeout=300)
    assert trained["status"] == "SUCCEEDED", trained["statusReason"]
    for iteration in (15, 30):
        done("export", f"{trained['run']}@{iteration}", "--episodes", "0")
        done("models", "register", f"{trained['run']}@{iteration}", "--name", "fast")

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
    ranked = [row["time"] for row in rows if row["rank"]]
    assert ranked == sorted(ranked)

    assert done("league", "verify", "cup", "1", "--rerun").splitlines() == [
        "entry 1: every lap is the same to the last bit"
    ]
    path = cup.path / "entries" / "2" / "entry.json"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes().replace(b'"racer": "bob"', b'"racer": "eve"'))
    altered = server.muster("league", "verify", "cup")
    assert altered.returncode == 1 and "entry 2: league cup: entry 2 is altered" in altered.stdout
    assert [row["status"] for row in json.loads(done("league", "table", "cup", "--json")) if row["entry"] == 2] == [
        "altered"
    ]
