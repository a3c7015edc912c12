"""``muster league`` through a real server: what is submitted, entered, refused and shown; the races are written by hand. And ``muster tracks``."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from racer.store import leagues
from racer.tracks.naming import resolve
from shared_store.volume import models
from shared_store.volume.bundles import seal
from shared_store.volume.checkpoints import Checkpoint
from shared_store.volume.evaluations import evaluation_name
from shared_store.volume.files import write_json
from shared_store.volume.layout import Store
from shared_store.volume.models import Model
from tests.conftest import Serving, call_muster
from tests.support.orchestrator.jobs import FOREVER
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run
from tests.support.racer.leagues import league, race, summary

TRAIN = {"task": "Racer", "worlds": 4, "iterations": 9}
JOBS = 6


class Paddock:
    """A server with models of racers, jobs that have ended, whose races are written here, and no room for another job."""

    def __init__(self, home: Path) -> None:
        self.server = Serving(home, "--cpus", "1")
        self.store = Store(home / "store")
        add_run(self.store, "racer", {**SPEC, "name": "racer", "train": TRAIN})
        for version, task in enumerate(("Racer", "Racer", "Cartpole", "my_tasks:Rocket"), 1):
            checkpoint = add_checkpoint(self.store, "racer", 10 + version, task=task, train=TRAIN)
            self.model(checkpoint, task)
        self.jobs = [self.server.gang("pass") for _ in range(JOBS)]
        for job in self.jobs:
            assert self.server.wait(job)["status"] == "SUCCEEDED"
        self.ended = time.time()
        self.server.wait(self.server.gang(FOREVER, cpus="1", name="blocker"), "RUNNING")

    def model(self, checkpoint: Checkpoint, task: str) -> Model:
        run = self.store.run("racer")
        bundle = run.exports / checkpoint.name
        bundle.mkdir(parents=True)
        (bundle / "policy.onnx").write_bytes(b"weights")
        seal(bundle, {"task": task, "train": TRAIN, "checkpoint_files": checkpoint.manifest["files"]})
        return models.register(self.store, "fast", run, checkpoint, {"queue": "default"})

    def raced(self, job: int, driven: dict[str, Any], version: int = 1, **changes: Any) -> str:
        """Leave the race that a job would have left; the id of the job."""
        named = self.jobs[job]
        name = evaluation_name(f"{10 + version:08d}-e1", named)
        found = {**summary(driven, seed=1, job=named), **changes}
        write_json(self.store.run("racer").evaluations / f"{name}.json", found)
        return named

    def muster(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return self.server.muster("league", *arguments)

    def done(self, *arguments: str) -> str:
        ended = self.muster(*arguments)
        assert ended.returncode == 0, ended.stdout + ended.stderr
        return ended.stdout

    def refused(self, *arguments: str) -> str:
        ended = self.muster(*arguments)
        assert ended.returncode in (1, 2) and len(ended.stderr.splitlines()) == 1, ended.stdout + ended.stderr
        return ended.stderr

    def races(self) -> list[dict[str, Any]]:
        """The jobs of races."""
        expected = [{"name": "JOB_NAME", "values": ["race-*"]}]
        listed = self.server.client.batch("ListJobs", jobQueue="default", filters=expected)
        found: list[dict[str, Any]] = listed["jobSummaryList"]
        return found

    def rows(self, league: str, *options: str) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = json.loads(self.done("table", league, "--json", *options))
        return rows


@pytest.fixture(scope="module")
def paddock(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Paddock]:
    paddock = Paddock(tmp_path_factory.mktemp("home"))
    yield paddock
    paddock.server.close()


def test_a_league_is_created_once_listed_and_shown(paddock: Paddock) -> None:
    options = ("--track", "oval", "--track", "random:7", "--laps", "4", "--ranking", "best", "--continuous")
    message = paddock.done("create", "grand", *options, "--off-track-penalty", "2", "--closes", "2999-01-01T00:00Z")
    assert "grand: 4 laps on oval, random:7; open until 2999-01-01 00:00:00 UTC" in message
    assert "put back at most 100 times in a lap; 2 s off the track, 1 s for a crash" in message
    league = leagues.find(paddock.store, "grand").definition()
    assert (league.track, league.rules.laps, league.rules.off_track_penalty) == (("oval", "random:7"), 4, 2.0)
    assert league.closes == 32_472_144_000.0 and league.owner.startswith("user ")
    output = paddock.refused("create", "grand", "--track", "oval")
    assert "grand exists already, and a league is never changed" in output
    (row,) = [each for each in paddock.done("list").splitlines() if each.startswith("grand ")]
    assert row.split()[:6] == ["grand", "oval,", "random:7", "4", "best", "0"]
    assert paddock.done("show", "grand") == message
    assert paddock.done("table", "grand") == "grand has no entries yet; muster league submit grand MODEL\n"


REFUSED = {
    "create x --track ovel": "track ovel does not exist; did you mean oval?",
    "create a/b --track oval": "league name 'a/b': use letters, digits",
    "create x": "--track is missing",
    "create x --track oval --ranking totl": "--ranking totl: there is no such ranking; did you mean total?",
    "create x --track oval --laps 0": "--laps: expected a value greater than or equal to 1",
    "create x --track oval --closes 2020-01-01T00:00Z": "2020-01-01 00:00:00 UTC is past: no race could",
    "create x --track oval --opens soon": "--opens soon: expected a time such as 2026-12-24T18:00",
    "create x --track oval --opens 2030-01-02 --closes 2030-01-01": "would close before it opens",
    "show cpu": "league cpu does not exist",
    "show cup 7": "league cup: entry 7 does not exist",
    "submit cup fats": "model fats does not exist; did you mean fast?",
    "submit cup fast@9": "model fast has no version 9; available: 1, 2, 3, 4",
    "submit cup fast@x": "fast@x: expected a version after @, such as fast@1",
    "submit cup fast@3": "model fast@3 is of task Cartpole; a league takes models of the racer's installed tasks",
    "submit cup fast@4": "model fast@4 is of task my_tasks:Rocket; a league takes models of the racer's",
    "submit cup fast@1 --as \x1b[31m": "use letters, digits, spaces",
    "submit cup fast@1 --evaluation nothing": "job nothing does not exist",
    "submit cup fast@1 --evaluation blocker": "is RUNNING: only a race that has SUCCEEDED is entered",
    "submit cup fast@1 --evaluation x --no-follow": "leave one of them out",
    "submit past fast@1": "league past closed at 2020-01-01 00:00:00 UTC",
    "submit future fast@1": "league future opens at 2999-01-01 00:00:00 UTC",
    "disqualify cup 9 --reason x": "league cup: entry 9 does not exist",
    "disqualify cup 9": "--reason is missing",
    "table cup -o cup.pdf": "unknown ending; use one of .csv, .png",
    "tabel cup": "did you mean table?",
}


@pytest.fixture(scope="module")
def cups(paddock: Paddock) -> Paddock:
    for options in (("cup",), ("future", "--opens", "2999-01-01T00:00Z")):
        paddock.done("create", *options, "--track", "oval")
    leagues.create(paddock.store, league("past", seed=1, closes=1_577_836_800.0))
    return paddock


@pytest.mark.parametrize("line", REFUSED)
def test_wrong_use_is_one_line_and_starts_nothing(cups: Paddock, line: str) -> None:
    before = cups.races()
    assert REFUSED[line] in cups.refused(*line.split(" "))
    assert cups.races() == before
    assert "x" not in leagues.names(cups.store)


def test_a_race_is_a_job_of_the_league_s_rules(cups: Paddock) -> None:
    cups.done("create", "long", "--track", "oval", "--laps", "5", "--continuous", "--seed", "11", "--seconds", "60")
    message = cups.done("submit", "long", "fast@2", "--as", "ada", "--no-follow")
    job = json.loads(cups.server.muster("list", "--json").stdout)[0]["jobId"]
    assert message.splitlines() == [
        f"submitted the race of fast@2 as {job}",
        f"enter it after it has ended: muster league submit long fast@2 --as 'ada' --evaluation {job[:8]}",
    ]
    detail = cups.server.detail(job)
    assert (detail["name"], detail["kind"], detail["queue"]) == ("race-long-fast-2", "race", "default")
    section = detail["spec"]["race"]
    assert (section["run"], section["checkpoint"], section["trials"], section["seed"]) == ("racer", 12, 5, 11)
    assert (section["track"], section["continuous"], section["seconds"]) == (["oval"], True, 60.0)
    assert section["config"] == leagues.CAR
    output = cups.refused("submit", "long", "fast@2", "--evaluation", job)
    assert "is RUNNABLE: only a race that has SUCCEEDED" in output
    cups.server.client.batch("TerminateJob", jobId=job, reason="seen")


def test_an_idempotency_key_answers_the_same_race_alone(cups: Paddock) -> None:
    before = len(cups.races())

    def raced(key: str, **body: Any) -> httpx.Response:
        headers = {"X-Muster-Idempotency-Key": key}
        url = f"{cups.server.client.url}/api/leagues/cup/races"
        return httpx.post(url, json={"model": "fast", "version": 1, **body}, headers=headers, timeout=60)

    first = raced("a-race").json()["jobId"]
    assert raced("a-race").json()["jobId"] == first and len(cups.races()) == before + 1
    for other in ({"version": 2}, {"directory": "/elsewhere"}):
        refused = raced("a-race", **other)
        assert refused.status_code == 409 and "was used for another request" in refused.json()["message"]
    assert len(cups.races()) == before + 1
    cups.server.client.batch("TerminateJob", jobId=first, reason="seen")


def test_races_are_entered_ranked_written_and_disqualified(cups: Paddock, tmp_path: Path) -> None:
    cups.done("create", "spring", "--track", "oval")
    slow, fast = cups.raced(0, race([14.0, 14.0, 14.5])), cups.raced(1, race([12.0, 12.5, 12.25], off_tracks=1), 2)
    message = cups.done("submit", "spring", "fast@1", "--as", "ada", "--evaluation", slow)
    assert message == "entry 1 of spring: ada with fast@1, 0:42.500, rank 1\n"
    row = json.loads(cups.done("submit", "spring", "fast@2", "--as", "Bob B.", "--evaluation", fast[:8], "--json"))
    assert (row["rank"], row["entry"], row["time"], row["off_tracks"]) == (1, 2, 36.75, 1)
    again = cups.refused("submit", "spring", "fast@2", "--as", "Bob B.", "--evaluation", fast)
    assert "league spring: entry 2 has this evaluation already" in again
    picture, table = tmp_path / "spring.png", tmp_path / "spring.csv"
    lines = cups.done("table", "spring", "-o", str(picture)).splitlines()
    assert " ".join(lines[1].split()) == "1 2 Bob B. fast@2 0:36.750 0:12.000 3 of 3 1 0 0 ranked"
    assert lines[2].split()[:5] == ["2", "1", "ada", "fast@1", "0:42.500"] and picture.read_bytes()[:4] == b"\x89PNG"
    assert "it exists; --overwrite replaces it" in cups.refused("table", "spring", "-o", str(picture))
    cups.done("table", "spring", "-o", str(table))
    with table.open() as file:
        first, second = csv.DictReader(file)
    assert (first["racer"], first["time"], second["rank"], second["model"]) == ("Bob B.", "36.75", "2", "fast@1")
    message = cups.done("disqualify", "spring", "2", "--reason", "not a car")
    assert message == "entry 2 of spring is disqualified: not a car\n"
    assert "entry 2 is disqualified already" in cups.refused("disqualify", "spring", "2", "--reason", "no")
    rows = [(each["rank"], each["entry"], each["status"]) for each in cups.rows("spring")]
    assert rows == [(1, 1, "ranked"), (None, 2, "disqualified")]
    shown = cups.done("show", "spring", "2")
    assert "disqualified: not a car" in shown and "0:12.500" in shown and f"job {fast}" in shown
    unchanged = [f"entry {number}: the entry and its model are unchanged" for number in (1, 2)]
    assert cups.done("verify", "spring").splitlines() == unchanged


def test_an_evaluation_that_is_not_of_the_league_s_race_is_not_entered(cups: Paddock) -> None:
    cups.done("create", "strict", "--track", "oval")
    job = cups.raced(2, race([12.0, 12.0, 12.0]))
    output = cups.refused("submit", "strict", "fast@2", "--evaluation", job)
    assert "it is of checkpoint 00000011-e1, the model of 00000012-e1" in output
    for driven, changes, output in (
        (race([12.0] * 3), {"seed": 5}, "its seed is 5, the league's 1"),
        ({**race([12.0] * 3), "trials": [{}] * 3}, {}, "race.trials.0: expected trial 1 with its status"),
    ):
        job = cups.raced(2, driven, **changes)
        assert output in cups.refused("submit", "strict", "fast@1", "--evaluation", job)
    output = cups.refused("submit", "strict", "fast@1", "--evaluation", cups.jobs[5])
    assert "has left no evaluation of run racer" in output and cups.rows("strict") == []


def test_a_race_that_was_submitted_in_time_is_entered_after_the_league_has_closed(cups: Paddock) -> None:
    leagues.create(cups.store, league("ended", seed=1, closes=cups.ended))
    job = cups.raced(3, race([12.0, 12.0, 12.0]))
    assert "league ended closed at" in cups.refused("submit", "ended", "fast@1")
    assert "rank 1" in cups.done("submit", "ended", "fast@1", "--evaluation", job)
    leagues.create(cups.store, league("missed", seed=1, closes=cups.ended - 3600))
    output = cups.refused("submit", "missed", "fast@1", "--evaluation", job)
    assert f"and job test ({job[:8]}) was not submitted in between" in output


def test_altered_entries_are_reported_and_not_ranked(cups: Paddock) -> None:
    cups.done("create", "honest", "--track", "oval")
    for job in (0, 1):
        cups.raced(job, race([12.0 + job] * 3), job + 1)
        cups.done("submit", "honest", f"fast@{job + 1}", "--as", f"r{job}", "--evaluation", cups.jobs[job])
    path = leagues.find(cups.store, "honest").path / "entries" / "1" / "entry.json"
    path.chmod(0o644)
    path.write_bytes(path.read_bytes().replace(b"12.0", b"10.0"))
    rows = cups.rows("honest")
    assert [(row["rank"], row["entry"], row["status"]) for row in rows] == [(1, 2, "ranked"), (None, 1, "altered")]

    def verified(*more: str) -> str:
        message = cups.muster("verify", "honest", *more)
        assert message.returncode == 1
        return message.stdout

    altered = "entry 1: the content of entry.json was altered (SHA-256 differs)\n"
    assert verified() == f"{altered}entry 2: the entry and its model are unchanged\n"
    shown = cups.muster("show", "honest", "1")
    assert (shown.returncode, shown.stdout) == (1, altered)
    listed = json.loads(verified("--json"))
    assert [(each["entry"], len(each["problems"])) for each in listed] == [(1, 1), (2, 0)]
    for command in ("show", "verify"):
        assert cups.muster(command, "honest", "2").returncode == 0

    onnx = models.find(cups.store, "fast", 2).bundle / "policy.onnx"
    onnx.chmod(0o644)
    onnx.write_bytes(b"Weights")
    output = "entry 2: model fast@2: the content of bundle/policy.onnx was altered (SHA-256 differs)\n"
    assert output in verified("2", "--rerun")
    before = cups.races()
    assert "model fast@2: the content of bundle/policy.onnx was altered" in cups.refused("submit", "honest", "fast@2")
    onnx.write_bytes(b"weights")
    weights = cups.store.run("racer").checkpoints / "00000012-e1" / "learner.pt"
    weights.write_bytes(b"Weights")
    assert "the content of learner.pt was altered" in cups.refused("submit", "honest", "fast@2")
    weights.write_bytes(b"weights")
    os.rename(weights.parent, weights.parent.with_name("away"))
    output = "checkpoint 00000012-e1 of run racer, which a race loads, is gone; register one that is there"
    assert output in cups.refused("submit", "honest", "fast@2")
    assert f"entry 2: model fast@2: {output}" in verified("2", "--rerun")
    os.rename(weights.parent.with_name("away"), weights.parent)
    assert cups.races() == before, "nothing was started"

    rules = leagues.find(cups.store, "honest").path / "definition" / "league.json"
    rules.chmod(0o644)
    rules.write_bytes(rules.read_bytes().replace(b'"seed": 1', b'"seed": 2'))
    output = "league honest: the content of league.json was altered"
    for send in (("table", "honest"), ("show", "honest"), ("submit", "honest", "fast@1")):
        assert output in cups.refused(*send)
    (message,) = [each for each in json.loads(cups.done("list", "--json")) if each["name"] == "honest"]
    assert output in message["problem"] and output in cups.done("list")


# -- tracks ------------------------------------------------------------------------------------------------------------


def test_tracks_are_made_imported_drawn_and_listed(shared_server: Serving, tmp_path: Path) -> None:
    home, picture, file = shared_server.home, tmp_path / "hills.png", tmp_path / "hills.npy"
    store = Store(shared_server.client.get("/api/capacity")["store"])

    def refused(*arguments: str) -> str:
        done = call_muster("tracks", *arguments, home=home)
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
        return done.stderr

    made = call_muster("tracks", "make", "hills", "--seed", "7", "--length", "40", "-o", str(picture), home=home)
    assert made.returncode == 0, made.stderr
    assert "hills: 40.00 m long, 1.00 m wide, counter-clockwise" in made.stdout and "seed 7, length 40" in made.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    track = resolve("hills", store)
    assert len(track.center) == round(40 / 0.15)

    assert "hills exists already, and tracks are immutable" in refused("make", "hills", "--seed", "8")
    assert "give one of --preset" in refused("make", "both", "--seed", "8", "--preset", "oval")
    assert "--roughness belongs to --seed" in refused("make", "x", "--preset", "oval", "--roughness", "1")
    assert "did you mean hills?" in refused("show", "hils")
    assert "it exists; --overwrite replaces it" in refused("show", "hills", "-o", str(picture))
    assert "unknown ending; use one of .png, .npy" in refused("show", "hills", "-o", str(tmp_path / "hills.gif"))

    shown = call_muster("tracks", "show", "hills", "-o", str(file), "--json", home=home)
    assert json.loads(shown.stdout)["digest"] == track.digest
    rows = np.load(file, allow_pickle=False)
    np.testing.assert_array_equal(rows, track.rows())

    np.save(tmp_path / "swapped.npy", rows[:, [0, 1, 4, 5, 2, 3]])
    swapped = call_muster("tracks", "import", str(tmp_path / "swapped.npy"), "--name", "copy", home=home)
    assert swapped.returncode == 0 and "mended:     the borders were swapped" in swapped.stdout, swapped.stderr
    rows[9] = np.nan
    np.save(tmp_path / "broken.npy", rows)
    output = refused("import", str(tmp_path / "broken.npy"), "--name", "broken")
    assert f"{tmp_path}/broken.npy: centre line: row 9" in output

    (store.path / "tracks" / "copy" / "manifest.json").unlink()
    listed = json.loads(call_muster("tracks", "list", "--json", home=home).stdout)
    assert [each["name"] for each in listed] == ["oval", "rounded-rectangle", "chicane", "copy", "hills"]
    assert "copy is damaged" in listed[3]["problem"] and listed[4]["origin"] == {"seed": 7, "length": 40.0}
    assert "track copy is damaged" in refused("show", "copy")
