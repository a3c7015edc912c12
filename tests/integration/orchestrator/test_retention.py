"""Retention through a controller: what real jobs leave goes, and no request loses the run that it is about."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from benchmarks import retention as benchmark
from benchmarks.load import Watch
from orchestrator.client import Client
from orchestrator.control.retention import RunNeeded
from orchestrator.control.run_store import RunStore
from orchestrator.domain.errors import ApiError
from orchestrator.server import Server
from shared_store.volume import contents, models, trash
from shared_store.volume.bundles import seal
from shared_store.volume.checkpoints import list_checkpoints
from tests.conftest import Serving
from tests.support.definitions import container, multinode, single
from tests.support.keys import HomeKeys
from tests.support.orchestrator.jobs import refused
from tests.support.orchestrator.trained import add_checkpoint, add_run


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    with Serving(tmp_path_factory.mktemp("home"), "--cpus", "4") as server:
        yield server


def runs_of(server: Serving) -> list[str]:
    return sorted(os.listdir(server.home / "store" / "runs"))


def output(server: Serving, *arguments: str) -> str:
    done = server.muster(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_what_jobs_of_the_batch_api_leave_goes_without_a_trace_but_what_they_made_stays(server: Serving) -> None:
    gang = server.gang("print('here')", nodes=2, name="gang")
    server.client.batch("RegisterJobDefinition", **single("one", container(["echo", "here"])))
    array = server.client.batch(
        "SubmitJob", jobName="array", jobQueue="default", jobDefinition="one", arrayProperties={"size": 3}
    )["jobId"]
    made = "import os, pathlib; pathlib.Path(os.environ['MUSTER_STORE'], 'runs', os.environ['MUSTER_RUN'], 'mine.csv').write_text('1')"
    maker = server.gang(made, name="maker")
    for each in (gang, array, maker):
        server.wait(each, "SUCCEEDED")
    kept = server.detail(maker)["run"]
    assert len(runs_of(server)) == 5
    plan = output(server, "gc", "--dry-run", "--older-than", "0m")
    assert "would delete 6 jobs and 4 runs" in plan and f"kept: run {kept}: it holds mine.csv" in plan
    assert output(server, "gc", "--dry-run").startswith("would delete 0 jobs"), "they are young"
    assert len(runs_of(server)) == 5
    taken = json.loads(output(server, "gc", "--older-than", "0m", "--json"))
    assert sum(len(each["jobs"]) for each in taken["runs"]) == 6
    assert taken["counts"]["jobs"] == 6 and taken["counts"]["runs"] == 4 and taken["counts"]["kept"] == 1
    assert runs_of(server) == [kept] and os.listdir(server.home / "store" / "trash") == []
    assert sorted(os.listdir(server.home / "store" / "runs" / kept / "logs")) == []
    for each in (gang, array, f"{array}:1", maker):
        with pytest.raises(ApiError, match="does not exist"):
            server.detail(each)
    nothing = output(server, "gc", "--older-than", "0m")
    assert nothing.startswith("deleted 0 jobs") and "no job of yours is old enough" in nothing


def test_an_archived_run_is_kept_out_of_lists_and_nothing_is_added_to_it(server: Serving) -> None:
    job = server.gang("print('here')", name="archived")
    run = server.wait(job, "SUCCEEDED")["run"]
    assert run in output(server, "runs", "list")
    assert "is archived" in output(server, "runs", "archive", run)
    assert run not in output(server, "runs", "list") and run in output(server, "runs", "list", "--archived")
    assert server.client.get(f"/api/runs/{run}")["archived"] is True
    again = multinode("again", container(["true"], env={"MUSTER_RUN": run}))
    server.client.batch("RegisterJobDefinition", **again)
    with pytest.raises(ApiError, match=f"run {run} is archived.*muster runs archive {run} --undo"):
        server.client.batch("SubmitJob", jobName="again", jobQueue="default", jobDefinition="again")
    with pytest.raises(ApiError, match="is archived"):
        server.client.post(f"/api/runs/{run}/resume", {})
    plan = output(server, "gc", "--dry-run", "--older-than", "0m")
    assert f"kept: run {run}: it is archived" in plan
    refused(["runs", "delete", run, "--yes"], server.home, 1, f"run {run} is kept: it is archived")
    output(server, "runs", "archive", run, "--undo")
    refused(["runs", "delete", run], server.home, 2, "add --yes")
    assert f"deleted run {run}: " in output(server, "runs", "delete", run, "--yes")
    assert run not in runs_of(server) and server.detail(job)["status"] == "SUCCEEDED"
    shown = output(server, "show", job)
    assert f"{run} (deleted, with its logs)" in shown and "node-0.log" not in shown
    assert f"run {run} was deleted, and the log of job {job} with it" in server.muster("logs", job).stderr
    refused(["runs", "delete", run, "--yes"], server.home, 2, f"run {run} does not exist")


def test_a_run_of_an_unfinished_job_is_neither_archived_nor_deleted(server: Serving) -> None:
    job = server.gang("import time; time.sleep(600)", name="busy")
    run = server.wait(job, "RUNNING")["run"]
    refused(["runs", "archive", run], server.home, 1, f"job {job} has not ended; stop it first")
    refused(["runs", "delete", run, "--yes"], server.home, 1, f"job {job} has not ended")
    server.client.batch("TerminateJob", jobId=job, reason="enough")
    server.wait(job)


def test_rules_are_checked_where_they_are_set(server: Serving) -> None:
    expected = "expected days, hours or minutes, such as 90d"
    for line, words in (
        ("serve --port 0 --retention soon", f"--retention: 'soon': {expected}"),
        ("serve --port 0 --retention 0d", "every job would be deleted as it ends"),
        ("gc --older-than x", f"older_than: 'x': {expected}, 36h or 45m"),
        ("gc --older-than off", f"older_than: 'off': {expected}, 36h or 45m"),
    ):
        refused(line.split(), server.home, 2, words)
    with pytest.raises(ApiError, match="is not a place in the list of jobs"):
        server.client.get("/api/gc", after="nowhere")
    queue = "arn:aws:batch:us-east-1:000000000000:job-queue/default"

    def set_tag(value: str) -> httpx.Response:
        return httpx.post(f"{server.url}/v1/tags/{queue}", json={"tags": {"muster:retention": value}})

    answer = set_tag("soon")
    assert answer.status_code == 400 and "tag muster:retention: 'soon': expected days" in answer.text
    assert set_tag("2h").status_code == 200
    try:
        job = server.gang("print('here')", name="young")
        server.wait(job)
        assert output(server, "gc", "--older-than", "0m").startswith("deleted 0 jobs"), "the queue's rule goes first"
    finally:
        assert set_tag("0.001m").status_code == 200
    output(server, "gc")
    with pytest.raises(ApiError, match="does not exist"):
        server.detail(job)
    httpx.delete(f"{server.url}/v1/tags/{queue}", params={"tagKeys": "muster:retention"}).raise_for_status()


def test_a_run_is_archived_and_deleted_by_its_owner_and_keys_with_all_queues_alone(tmp_path: Path) -> None:
    tokens = {
        name: HomeKeys(tmp_path).create(name, queues)
        for name, queues in (("admin", ()), ("a", ("default",)), ("b", ("default",)))
    }
    with Serving(tmp_path, "--cpus", "2") as server:
        clients = {name: Client(server.url, f"{key.access_key_id}:{key.secret}") for name, key in tokens.items()}
        server.client = clients["admin"]
        own = {}
        for name in ("a", "b"):
            registered = clients[name].batch("RegisterJobDefinition", **multinode(f"of-{name}", container(["true"])))
            job = clients[name].batch(
                "SubmitJob", jobName=name, jobQueue="default", jobDefinition=registered["jobDefinitionArn"]
            )["jobId"]
            own[name] = server.wait(job, "SUCCEEDED")["run"]
        message = rf"run {own['a']} was made by key a; its owner may, and a key with all queues"
        with pytest.raises(ApiError, match=message) as caught:
            clients["b"].delete(f"/api/runs/{own['a']}")
        assert caught.value.status == 403
        with pytest.raises(ApiError, match=message):
            clients["b"].post(f"/api/runs/{own['a']}/archive", {})
        taken = clients["b"].post("/api/gc", {"older_than": "0m"})["runs"]
        assert [each["run"] for each in taken] == [own["b"]], "a pass of one key leaves what another one's is"
        clients["a"].post(f"/api/runs/{own['a']}/archive", {})
        clients["admin"].post(f"/api/runs/{own['a']}/archive", {"archived": False})
        clients["a"].delete(f"/api/runs/{own['a']}")
        assert runs_of(server) == []
        for each in clients.values():
            each.close()


def test_store_and_database_stay_as_large_as_they_are_while_jobs_go_through() -> None:
    engine = benchmark.LoggingEngine(capacity=benchmark.large(2000))
    with benchmark.controller(engine, RunStore, Watch(loaded_anyway=True), retention=0.0) as bench:
        sizes = benchmark.rounds(bench, jobs=160, count=4)
    assert [(each.jobs, each.rows) for each in sizes] == [(0, 0)] * 4
    assert len({each.files for each in sizes}) == 1, sizes
    assert sizes[-1].database == sizes[1].database, sizes


# -- no request loses the run that it is about -----------------------------------------------------------------------------


@pytest.fixture
def trained(inside: Server) -> Iterator[str]:
    """A run with a checkpoint, of a controller in this process."""
    name = f"taught-{os.urandom(4).hex()}"
    add_run(inside.store, name)
    add_checkpoint(inside.store, name, 3)
    yield name


def delete_during(inside: Server, patch: pytest.MonkeyPatch, name: str) -> list[str]:
    """Have the run deleted, as soon as a request has read the store for the first time; what came of it."""
    calls, outcome = inside.controller.access.calls, list[str]()
    call = calls.call

    def deleting(body: Callable[[], Any], **options: Any) -> Any:
        result = call(body, **options)
        if not outcome:
            try:
                inside.controller.retention.delete(name)
                outcome.append("deleted")
            except RunNeeded as error:
                outcome.append(str(error))
        return result

    patch.setattr(calls, "call", deleting)
    return outcome


def evaluation(http: httpx.Client, run: str) -> httpx.Response:
    spec = json.dumps({"name": "x", "evaluate": {"run": run}})
    name = f"evaluates-{run}"
    definition = multinode(name, container(["true"], env={"MUSTER_SPEC": spec}))
    http.post("/v1/registerjobdefinition", json=definition).raise_for_status()
    job = {"jobName": "x", "jobQueue": "default", "jobDefinition": name}
    return http.post("/v1/submitjob", json=job)


def test_an_evaluation_of_a_run_that_is_deleted_meanwhile_is_refused(
    inside: Server, http: httpx.Client, trained: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        outcome = delete_during(inside, patch, trained)
        answer = evaluation(http, trained)
    assert outcome == ["deleted"] and answer.status_code == 404, answer.text
    assert f"run {trained} does not exist" in answer.text


def test_an_evaluation_that_waits_keeps_its_run(inside: Server, http: httpx.Client, trained: str) -> None:
    blocker = http.post(f"/api/runs/{trained}/resume", json={}).json()  # takes the only CPU
    waiting = evaluation(http, trained).json()["jobId"]
    with pytest.raises(RunNeeded, match=f"job {waiting} needs it"):
        inside.controller.retention.delete(trained)
    for job in (blocker.get("jobId"), waiting):
        if job:
            http.post("/v1/terminatejob", json={"jobId": job, "reason": "enough"})


@pytest.mark.parametrize(
    ("path", "body", "why"),
    [("clone", {"name": "twin"}, "run twin is a clone of it"), ("resume", {}, "job {job} has not ended")],
)
def test_a_run_that_is_cloned_or_resumed_is_not_deleted_meanwhile_nor_afterwards(
    inside: Server, http: httpx.Client, trained: str, monkeypatch: pytest.MonkeyPatch, path: str, body: Any, why: str
) -> None:
    with monkeypatch.context() as patch:
        outcome = delete_during(inside, patch, trained)
        answer = http.post(f"/api/runs/{trained}/{path}", json=body)
    assert answer.status_code == 200, answer.text
    assert outcome == [f"run {trained} is used by another request now; try again in a moment"]
    job = answer.json()["jobId"]
    with pytest.raises(RunNeeded, match=why.format(job=job)):
        inside.controller.retention.delete(trained)
    http.post("/v1/terminatejob", json={"jobId": job, "reason": "enough"})


def test_while_a_run_is_deleted_requests_about_it_are_refused(inside: Server, http: httpx.Client, trained: str) -> None:
    with inside.controller.retention.alone(trained):
        for path, body in (("resume", {}), ("clone", {"name": "late"}), ("models", {"name": "late"}), ("archive", {})):
            answer = http.post(f"/api/runs/{trained}/{path}", json=body)
            assert answer.status_code == 409 and "now; try again in a moment" in answer.text, (path, answer.text)
        answer = evaluation(http, trained)
        assert answer.status_code == 409, answer.text
        spec = multinode("continues", container(["true"], env={"MUSTER_RUN": trained}))
        http.post("/v1/registerjobdefinition", json=spec).raise_for_status()
        job = {"jobName": "x", "jobQueue": "default", "jobDefinition": "continues"}
        assert http.post("/v1/submitjob", json=job).status_code == 409
    assert http.get(f"/api/runs/{trained}").status_code == 200


def test_a_volume_that_fails_is_answered_in_one_line(
    inside: Server, http: httpx.Client, trained: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error", "/volume")

    for module, name in ((trash, "discard"), (contents, "archive"), (contents, "unarchive")):
        monkeypatch.setattr(module, name, fail)
    for answer in (
        http.delete(f"/api/runs/{trained}"),
        http.post(f"/api/runs/{trained}/archive", json={}),
        http.post(f"/api/runs/{trained}/archive", json={"archived": False}),
    ):
        assert answer.status_code == 503 and "the store can't be used ([Errno 5] Input/output error" in answer.text


def test_a_run_of_a_model_is_not_deleted(inside: Server, http: httpx.Client, trained: str) -> None:
    run = inside.store.run(trained)
    checkpoint = list_checkpoints(run)[-1]
    bundle = run.exports / checkpoint.name
    bundle.mkdir(parents=True)
    (bundle / "policy.onnx").write_bytes(b"x")
    seal(bundle, {})
    models.register(inside.store, f"model-{trained}", run, checkpoint, {})
    answer = http.delete(f"/api/runs/{trained}")
    assert answer.status_code == 409 and f"model model-{trained}@1 is of it" in answer.text
    assert contents.contents(run).results == ("checkpoints", "exports")
