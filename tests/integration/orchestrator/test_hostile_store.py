"""What lies on the volume was written by jobs and may be anything: no file of it breaks a list, an answer or the server."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import select

from orchestrator.api.logs.log_events import log_file
from orchestrator.client import Client
from orchestrator.persistence.batch_models import Job, JobQueue
from orchestrator.persistence.session import Database, DatabaseError
from orchestrator.server import Server
from shared_store.volume.epoch import close_claim, raise_epoch, read_epoch
from shared_store.volume.files import DamagedFile, write_json
from shared_store.volume.layout import Run
from shared_store.volume.log_files import LogWriter
from shared_store.volume.log_view import LogView
from shared_store.volume.logs import format_line
from shared_store.volume.node_outcomes import Outcome, read_outcome, write_outcome
from tests.conftest import call_muster, submit_gang, wait_for
from tests.support.definitions import nodes_of

SPEC = {"name": "a", "train": {"task": "Cartpole", "worlds": 4, "iterations": 2}}
NODES = nodes_of({"command": ["true"]})
DAMAGED: dict[str, bytes] = {
    "zeros": b"\0" * 4096,
    "empty": b"",
    "cut": b'{"run": "cut", "sp',
    "list": b"[]",
    "deep": b'{"spec": ' * 5000 + b"1" + b"}" * 5000,
    "latin": b'{"run": "\xe4"}',
    "text": b'{"spec": "train"}',
    "large": b'{"spec": {"a": "%s"}}' % (b"x" * 1_000_000),
    "half": b'{"spec": {"name": "\\ud800"}}',
    "huge": b'{"created": 1e999}',
}


@pytest.fixture(scope="module")
def runs(inside: Server) -> Path:
    """A store with a good run at either end of the list and damaged ones between."""
    runs = inside.store.path / "runs"
    for name in ("a-good", "z-good"):
        write_json(runs / name / "run.json", {"run": name, "created": 1, "spec": SPEC})
    for name, content in DAMAGED.items():
        (runs / f"d-{name}").mkdir()
        (runs / f"d-{name}" / "run.json").write_bytes(content)
    (runs / "d-directory" / "run.json").mkdir(parents=True)
    (runs / "d-pipe").mkdir()
    os.mkfifo(runs / "d-pipe" / "run.json")
    (runs / "d-link").mkdir()
    (runs / "d-link" / "run.json").symlink_to(runs / "a-good" / "run.json")
    return runs


def refused(answer: httpx.Response) -> str:
    """The one line of a refusal that is the client's or the run's fault."""
    assert 400 <= answer.status_code < 500, answer.text[:300]
    message: str = answer.json()["message"]
    assert "\n" not in message and len(message) <= 2000
    return message


def test_a_list_of_runs_shows_those_that_are_damaged_with_their_problem(http: httpx.Client, runs: Path) -> None:
    shown = {each["run"]: each.get("problem") for each in http.get("/api/runs").json()}
    assert {f"d-{name}" for name in (*DAMAGED, "directory", "pipe", "link")} < shown.keys()
    assert shown["a-good"] is shown["z-good"] is None
    assert all("run.json" in problem for name, problem in shown.items() if name.startswith("d-"))


@pytest.mark.parametrize("name", [*DAMAGED, "directory", "pipe", "link"])
def test_the_pages_of_a_damaged_run_are_refused_in_one_line(http: httpx.Client, runs: Path, name: str) -> None:
    for path in ("", "/checkpoints", "/metrics"):
        assert "damaged file" in refused(http.get(f"/api/runs/d-{name}{path}"))
    assert "damaged file" in refused(http.post(f"/api/runs/d-{name}/resume", json={}))


MANIFESTS: dict[str, Any] = {
    "00000001-e1": {"files": {"a": {"size": "x", "sha256": "0"}}, "format": 1},
    "00000002-e1": {"files": {"a": {"size": None, "sha256": "0"}}, "format": 1},
    "00000003-e1": {"files": {"../../../../etc/passwd": {"size": 1, "sha256": "0"}}, "format": 1},
    "00000004-e1": {"files": {"a\0b": {"size": 1, "sha256": "0"}}, "format": 1},
    "00000005-e1": {"files": {}, "format": 1, "reward": {"a": "b"}},
    "00000006-e1": {"files": {}, "format": 1, "created": "x" * 100_000},
}


def test_damaged_checkpoints_are_listed_with_their_problem(http: httpx.Client, runs: Path) -> None:
    run = runs / "checkpointed"
    write_json(run / "run.json", {"run": "checkpointed", "spec": SPEC})
    for name, manifest in MANIFESTS.items():
        write_json(run / "checkpoints" / name / "manifest.json", manifest, levels=2)
    deep = run / "checkpoints" / "00000007-e1" / "manifest.json"
    deep.parent.mkdir()
    deep.write_text('{"files": ' + "[" * 5000 + "]" * 5000 + "}")
    write_json(run / "evaluations" / "00000007-e1.json", {"return": 1.0})
    (run / "evaluations" / "00000007-e1.json").write_text("[" * 5000)
    for query in ("", "?verify=true"):
        listed = http.get(f"/api/runs/checkpointed/checkpoints{query}")
        assert listed.status_code == 200 and len(listed.json()) == 7 and len(listed.text) < 10_000
        assert all("manifest.json" in each["problem"] for each in listed.json())
    assert http.get("/api/runs/checkpointed").json()["evaluation"] is None


def test_no_change_of_a_run_and_no_spec_makes_an_answer_long(inside: Server, http: httpx.Client, runs: Path) -> None:
    levels = [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 8)}]" for n in range(1, 9)]
    bomb = ", ".join(["a0: &a0 [x, x, x, x, x, x, x, x]", *levels])
    output = refused(http.post("/api/runs/a-good/resume", json={"set": [f"train.config={{{bomb}}}"]}))
    assert "anchors and aliases (&a0) are not accepted here" in output and len(output) < 400
    train = {**SPEC["train"], "task": "my:Task", "config": {"text": "x" * 100_000}}
    spec = {**SPEC, "train": train}
    write_json(runs / "crafted" / "run.json", {"run": "crafted", "spec": spec})
    output = refused(http.post("/api/runs/crafted/resume", json={"set": ["train.config={text: y}"]}))
    assert "train.config.text is" in output and len(output) < 400
    assert "at most 24576" in refused(http.post("/api/runs/a-good/resume", json={"set": ["name=" + "x" * 30_000]}))


def test_runs_come_in_pages_that_together_hold_each_run_once(http: httpx.Client, runs: Path) -> None:
    seen, address = [], "/api/runs?max=4"
    while address:
        page = http.get(address)
        assert len(page.json()) <= 4
        seen += [each["run"] for each in page.json()]
        address = page.links["next"]["url"] if "next" in page.links else ""
    assert seen == sorted(path.name for path in runs.iterdir())
    assert "max" in refused(http.get("/api/runs?max=100000"))


def test_after_an_internal_error_a_client_is_served(
    inside: Server, http: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise KeyError("two\nlines")

    with httpx.Client(base_url=inside.url) as client:
        for _ in range(3):
            with monkeypatch.context() as patched:
                patched.setattr(inside.controller.engines, "capacity", fail)
                answer = client.get("/api/capacity")
            assert answer.status_code == 500 and answer.headers["connection"] == "close"
            assert answer.json()["message"] == "internal error; the controller's log has the details"
            assert client.get("/healthz").status_code == 200


def damaged_home(home: Path) -> Path:
    """A home whose database was written by a controller, with zeros over the pages of the table of jobs."""
    database = Database.at(home)
    with database.session() as session:
        facts = {"name": "j", "queue": "default", "definition": "d", "request": {}, "node_properties": NODES}
        session.add_all(Job(id=f"j{n}", run=f"r{n}", **facts) for n in range(500))
    with database.engine.connect() as connection:
        connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
        size = connection.exec_driver_sql("PRAGMA page_size").scalar_one()
        root = connection.exec_driver_sql("SELECT rootpage FROM sqlite_master WHERE name = 'jobs'").scalar_one()
    database.close()
    with open(home / "muster.db", "r+b") as file:
        file.seek((root - 1) * size)
        file.write(b"\xff" * size)
    return home / "muster.db"


def test_a_damaged_page_of_the_database_is_reported_in_one_line_at_the_start(tmp_path: Path) -> None:
    path = damaged_home(tmp_path)
    served = call_muster("serve", "--port", "0", home=tmp_path)
    assert served.returncode == 1 and served.stderr.count("\n") == 1, served.stderr
    assert f"{path} is damaged" in served.stderr and f"`sqlite3 {path} .recover`" in served.stderr


def test_a_damaged_page_found_while_serving_is_reported_to_each_request(tmp_path: Path) -> None:
    path = damaged_home(tmp_path)
    database = Database.at(tmp_path)
    for _ in range(2):
        damaged = pytest.raises(DatabaseError, match=f"{path} is damaged .*malformed")
        with damaged as refused, database.session() as session:
            session.scalars(select(Job)).all()
        assert "\n" not in str(refused.value)
    with pytest.raises(DatabaseError, match="is damaged"), database.session() as session:
        session.scalars(select(JobQueue)).all()  # of pages that can still be read: nothing more is written to this file
    database.close()


def test_a_job_is_read_whatever_it_put_in_place_of_files(
    inside: Server, http: httpx.Client, runs: Path, tmp_path: Path
) -> None:
    secret = tmp_path / "secret"
    secret.write_text("2026-01-01T00:00:00.000Z 0 o not yours\n")
    job = submit_gang(Client(inside.url), "print('printed')")
    wait_for(lambda: http.get(f"/api/jobs/{job}").json()["status"] == "SUCCEEDED", 60, "its end")
    run = inside.store.run(http.get(f"/api/jobs/{job}").json()["run"])
    (run.path / "run.json").write_text("{")
    log = run.log(job, 1, 0)
    (log.parent / "node-1.log").symlink_to(secret)
    os.mkfifo(log.parent / "node-2.log")
    run.metrics.mkdir()
    os.mkfifo(run.metrics / "metrics-e1.jsonl")
    (run.metrics / "metrics-e2.jsonl").write_text('{"iteration": 1, "reward": 1e999}\n' + "[" * 5000 + "\n")
    (run.metrics / "metrics-e3.jsonl").symlink_to(secret)
    detail = http.get(f"/api/jobs/{job}").json()
    assert (detail["status"], detail["results"], detail["progress"]) == ("SUCCEEDED", None, None)
    for follow in ("false", "true"):
        lines = http.get(f"/api/jobs/{job}/logs", params={"follow": follow}).text
        assert "printed" in lines and "not yours" not in lines


def test_links_and_pipes_that_a_job_put_in_place_of_files_are_neither_followed_nor_waited_for(tmp_path: Path) -> None:
    run, victim = Run(tmp_path / "run"), tmp_path / "victim"
    run.path.mkdir()
    victim.write_text("kept")
    (tmp_path / "node-0.log").symlink_to(victim)
    with pytest.raises(OSError):
        LogWriter(tmp_path / "node-0.log")
    os.mkfifo(run.path / "EPOCH")
    with pytest.raises(DamagedFile, match="EPOCH: not a regular file"):
        read_epoch(run)
    (run.path / "EPOCH.1").symlink_to(victim)
    os.mkfifo(run.path / "EPOCH.2")
    (run.path / "EPOCH.3").mkdir()
    for epoch in (1, 2, 3):
        with pytest.raises(DamagedFile, match=f"EPOCH.{epoch}: not a regular file"):
            close_claim(run, epoch)
    assert victim.read_text() == "kept"


def test_nothing_is_read_or_written_through_a_run_that_is_a_link(
    inside: Server, http: httpx.Client, runs: Path, tmp_path: Path
) -> None:
    write_json(tmp_path / "elsewhere" / "run.json", {"run": "e-linked", "spec": SPEC})
    (runs / "e-linked").symlink_to(tmp_path / "elsewhere")
    for path in ("", "/checkpoints", "/metrics"):
        assert "e-linked: a link" in refused(http.get(f"/api/runs/e-linked{path}"))
    assert {each["run"]: each.get("problem", "") for each in http.get("/api/runs").json()}["e-linked"].count("a link")
    run = inside.store.run("e-linked")
    for work in (lambda: read_epoch(run), lambda: raise_epoch(run, 1), lambda: close_claim(run, 1)):
        with pytest.raises(DamagedFile, match="e-linked: a link"):
            work()
    assert os.listdir(tmp_path / "elsewhere") == ["run.json"]
    (runs / "e-linked").unlink()


@pytest.mark.parametrize("place", ["logs", "logs/job", "logs/job/1", "outcomes", "outcomes/job", "outcomes/job/1"])
def test_logs_and_outcomes_are_neither_read_nor_written_through_a_link(tmp_path: Path, place: str) -> None:
    run, other = Run(tmp_path / "run"), tmp_path / "other"
    outcome = Outcome(0, 1, 0, None, "done", None, 1.0, 2.0)
    for each in (other, other / "1", other / "job" / "1"):
        each.mkdir(parents=True, exist_ok=True)
        (each / "node-0.log").write_text(format_line(1.0, 0, "o", "not yours"))
        write_json(each / "node-0.json", asdict(outcome))
    before = {path: path.read_bytes() for path in other.rglob("*") if path.is_file()}
    (run.path / place).parent.mkdir(parents=True)
    (run.path / place).symlink_to(other)
    assert not list(LogView.of(run, "job").drain()) and not log_file(run.log("job", 1, 0), "s").snapshot().segments
    assert read_outcome(run, "job", 1, 0) is None
    kind = place.partition("/")[0]
    with pytest.raises(DamagedFile, match=f"{place}: a link"):
        if kind == "logs":
            LogWriter(run.log("job", 1, 0))
        else:
            write_outcome(run, "job", 1, outcome)
    assert {path: path.read_bytes() for path in other.rglob("*") if path.is_file()} == before


def test_a_log_stream_ends_in_order_whatever_lies_there(
    inside: Server, http: httpx.Client, caplog: pytest.LogCaptureFixture
) -> None:
    job = submit_gang(Client(inside.url), "print('printed')")
    wait_for(lambda: http.get(f"/api/jobs/{job}").json()["status"] == "SUCCEEDED", 60, "its end")
    logs = inside.store.run(http.get(f"/api/jobs/{job}").json()["run"]).path / "logs" / job
    (logs / "²").mkdir()
    (logs / ("9" * 200)).mkdir()
    (logs / "1" / "node-².log").write_text("")
    address = f"/api/jobs/{job}/logs"
    for follow in (False, True):
        assert "printed" in http.get(address, params={"follow": follow}).text
        assert http.get(address, params={"follow": follow, "attempt": "9" * 300}).text == ""
    logs.rename(logs.with_name("before"))
    logs.write_text("")
    assert [http.get(address, params={"follow": follow}).text for follow in (False, True)] == ["", ""]
    streams = {"X-Amz-Target": "Logs_20140328.DescribeLogStreams"}
    for requested in ({}, {"orderBy": "LastEventTime"}):
        listed = http.post("/", json={"logGroupName": "/aws/batch/job", **requested}, headers=streams)
        assert listed.status_code == 200, "one job's files are in the way of nothing but its own logs"
    assert "Exception in ASGI application" not in caplog.text
