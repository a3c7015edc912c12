"""Webhooks of a real controller to a real receiver: signed, tried again, not lost when the controller is killed."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from orchestrator.client import Client
from orchestrator.domain.job import Status
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.own_models import WebhookDelivery
from orchestrator.server import Server
from tests.conftest import Serving, submit_gang
from tests.support.orchestrator import rows
from tests.support.orchestrator.jobs import serving
from tests.support.orchestrator.receiver import SECRET, Receiver, receiving, write_webhooks
from tests.support.processes import end_all
from tests.support.waiting import wait_for


@pytest.fixture(scope="module")
def listening() -> Iterator[Receiver]:
    with receiving() as receiver:
        yield receiver


@pytest.fixture
def receiver(listening: Receiver) -> Receiver:
    """The receiver, which has heard nothing yet."""
    listening.messages.clear()
    return listening


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory, listening: Receiver) -> Iterator[Serving]:
    """A controller that tells the receiver of every end."""
    home = tmp_path_factory.mktemp("reported")
    file = write_webhooks(home / "hooks.json", chat={"url": listening.url, "link": "https://muster.example/"})
    with Serving(home / "home", "--cpus", "2", "--webhooks", file) as server:
        yield server


def is_signed(headers: dict[str, str], body: bytes) -> bool:
    """Whether the signature is that of Standard Webhooks, and fresh."""
    key = base64.b64decode(SECRET.removeprefix("whsec_"))
    signed = b".".join([headers["webhook-id"].encode(), headers["webhook-timestamp"].encode(), body])
    expected = base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()
    assert abs(time.time() - int(headers["webhook-timestamp"])) < 300
    return headers["webhook-signature"] == f"v1,{expected}"


def test_the_receiver_learns_of_each_end_once_and_the_message_is_signed(reported: Serving, receiver: Receiver) -> None:
    good, bad = reported.gang("print(1)", name="good"), reported.gang("raise SystemExit(3)", name="bad")
    stopped = reported.gang("import time; time.sleep(3600)", name="stopped")
    reported.wait(stopped, "RUNNING")
    reported.client.batch("TerminateJob", jobId=stopped, reason="enough")
    for job in (good, bad, stopped):
        reported.wait(job)
    wait_for(lambda: reported.client.get("/api/webhooks")[0]["waiting"] == 0, 20, "all delivered")
    assert len(receiver.messages) == 3, "none of them twice"
    for job, kind, code in ((good, "job.succeeded", 0), (bad, "job.failed", 3), (stopped, "job.failed", None)):
        ((headers, body),) = receiver.of(job)
        assert is_signed(headers, body) and headers["content-type"] == "application/json"
        message = json.loads(body)
        data, detail = message["data"], reported.detail(job)
        ended = (kind, detail["status"], detail["statusReason"])
        assert (message["type"], data["status"], data["statusReason"]) == ended
        assert (data["name"], data["run"], data["queue"]) == (detail["name"], detail["run"], "default")
        assert (data["attempts"], data["stopped"]) == (1, job == stopped)
        assert data["exitCode"] == code or job == stopped
        assert data["link"] == f"https://muster.example/api/jobs/{job}"
        assert message["timestamp"] == data["stoppedAt"] > data["startedAt"] >= data["createdAt"]


def test_a_message_is_tried_again_by_the_next_controller_unchanged(reported: Serving, receiver: Receiver) -> None:
    receiver.answers = [500]
    job = reported.gang("print(1)")
    wait_for(lambda: receiver.of(job), 20, "a first try")
    reported.kill()
    reported.start()
    wait_for(lambda: len(receiver.of(job)) == 2, 20, "a second try")
    wait_for(lambda: reported.client.get("/api/webhooks")[0]["waiting"] == 0, 20, "it is delivered")
    (first, body), (second, again) = receiver.of(job)
    assert first["webhook-id"] == second["webhook-id"] and body == again
    assert is_signed(first, body) and is_signed(second, again)


def test_a_slow_or_unreachable_receiver_delays_no_job(reported: Serving, receiver: Receiver) -> None:
    receiver.gate.clear()
    first = reported.gang("print(1)", name="first")
    wait_for(lambda: receiver.of(first), 20, "a message that is not answered")
    for name in ("second", "third"):
        reported.wait(reported.gang("print(1)", name=name), "SUCCEEDED")
    assert len(receiver.messages) == 1 and reported.client.get("/api/webhooks")[0]["waiting"] == 3
    receiver.gate.set()
    wait_for(lambda: len(receiver.messages) == 3, 20, "the others")


def test_the_command_lists_webhooks_without_secrets_and_sends_samples(reported: Serving, receiver: Receiver) -> None:
    command = partial(reported.muster, "webhooks")
    sent = command("test", "chat")
    ((headers, body),) = receiver.messages
    place = f"http://127.0.0.1:{receiver.server_port}"
    accepted, note = sent.stdout.splitlines()
    assert accepted == f"chat: {place} accepted the sample (webhook-id {headers['webhook-id']})", sent.stderr
    assert note == "this sample belongs to no job; muster webhooks list does not count it"
    assert is_signed(headers, body) and json.loads(body)["type"] == "webhook.test"
    receiver.answers = [302]
    refused = command("test", "chat")
    assert refused.returncode == 1 and f"{place} answered 302" in refused.stdout, "no redirect is followed"
    unknown = command("test", "chatt")
    assert (unknown.returncode, unknown.stderr) == (2, "muster: webhook chatt does not exist; did you mean chat?\n")
    listed = command("list")
    assert "chat" in listed.stdout and place in listed.stdout
    everything = listed.stdout + command("list", "--json").stdout
    assert SECRET not in everything and "a-path-that-is-secret" not in everything


def test_an_undeliverable_message_is_given_up(
    tmp_path: Path, receiver: Receiver, caplog: pytest.LogCaptureFixture
) -> None:
    receiver.answers = [500, 503, 404]
    with receiving() as gone:
        absent = gone.url
    file = write_webhooks(tmp_path / "hooks.json", chat={"url": receiver.url}, absent={"url": absent})
    server = Server(tmp_path / "home", cpus=1, webhooks=file)
    server.deliveries._pauses = (0.05, 0.05)
    server.start()
    with Client(server.url) as client:
        job = submit_gang(client, "print(1)")
        wait_for(lambda: all(each["failed"] for each in client.get("/api/webhooks")), 20, "both are given up")
        chat, gone_one = client.get("/api/webhooks")
        metrics = server.controller.monitoring.registry.get_sample_value
        counted = {"webhook": "chat", "result": "failed"}, {"webhook": "chat", "result": "given up"}
        assert [metrics("muster_webhook_tries_total", labels) for labels in counted] == [2.0, 1.0]
    (message,) = chat["failed"]
    assert (message["job"], message["tries"], message["problem"]) == (job, 3, "answered 404")
    assert gone_one["failed"][0]["problem"] == "can't be reached (ConnectError)"
    assert len({headers["webhook-id"] for headers, _ in receiver.messages}) == 1 and len(receiver.messages) == 3
    server.close()
    end_all(tmp_path)
    assert f"message {message['id']} about job {job} is given up: answered 404" in caplog.text
    assert SECRET not in caplog.text and "a-path-that-is-secret" not in caplog.text
    database = b"".join(path.read_bytes() for path in (tmp_path / "home").glob("muster.db*"))
    assert SECRET.encode() not in database and b"a-path-that-is-secret" not in database


def test_a_receiver_that_answers_a_byte_at_a_time_is_left_after_the_deadline_of_the_whole_try(tmp_path: Path) -> None:
    with receiving() as dripping:
        dripping.drip = threading.Event()
        file = write_webhooks(tmp_path / "hooks.json", chat={"url": dripping.url})
        server = Server(tmp_path / "home", cpus=1, webhooks=file)
        server.deliveries._timeout = 0.5
        try:
            problem = server.deliveries.test(server.deliveries.webhooks["chat"])["problem"]
        finally:
            server.close()
        assert problem == "has not answered within 0.5 s"
        assert dripping.drip.wait(30), "the connection is closed, not kept"


def test_an_unknown_queue_is_named_with_the_nearest_one(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    chat = {"url": "http://127.0.0.1:1/", "queues": ["default", "defualt"]}
    file = write_webhooks(tmp_path / "hooks.json", chat=chat)
    server = Server(tmp_path / "home", cpus=1, webhooks=file)
    server.start()
    server.close()
    reported = [each.getMessage() for each in caplog.records if each.name == "muster.webhooks"]
    assert reported == ["webhook chat: Job queue defualt does not exist; did you mean default?"]


def test_the_message_is_written_with_the_end_of_the_job_or_not_at_all(tmp_path: Path) -> None:
    with receiving() as gone:
        here = {"url": gone.url}
    file = write_webhooks(tmp_path / "hooks.json", chat=here, trained={**here, "kinds": ["train"]})
    server = Server(tmp_path / "home", cpus=1, webhooks=file)  # nothing is started: nothing is sent
    with server.controller.database.session() as session:
        session.add_all([rows.job("a", status=Status.RUNNING), rows.job("b", status=Status.RUNNING)])
    with pytest.raises(RuntimeError), server.controller.database.session() as session:
        session.get_one(Job, "a").move(Status.FAILED, "no")
        session.flush()
        raise RuntimeError
    with server.controller.database.session() as session:
        assert session.scalars(select(WebhookDelivery)).all() == []
        session.get_one(Job, "b").move(Status.SUCCEEDED)
    with server.controller.database.session() as session:
        (row,) = session.scalars(select(WebhookDelivery))
        assert (row.webhook, row.job, row.tries, row.body) == ("chat", "b", 0, None)
    server.close()


def test_messages_of_an_unknown_webhook_wait_for_a_controller_that_is_not_a_commands(tmp_path: Path) -> None:
    with receiving() as gone:
        here = {"url": gone.url}
    home = tmp_path / "home"
    server = Server(home, cpus=1, webhooks=write_webhooks(tmp_path / "hooks.json", chat=here))
    with server.controller.database.session() as session:
        session.add(rows.job("a", status=Status.RUNNING))
    with server.controller.database.session() as session:
        session.get_one(Job, "a").move(Status.SUCCEEDED)
    server.close()
    for file, problem in (
        (None, None),
        (write_webhooks(tmp_path / "hooks.json", other=here), "the webhook was removed from the configuration"),
    ):
        server = Server(home, cpus=1, webhooks=file, temporary=file is None)
        server.start()
        with server.controller.database.session() as session:
            (row,) = session.scalars(select(WebhookDelivery))
            assert (row.problem or "").startswith(problem or "") and (row.next_at is None) == (problem is not None)
        server.close()


def test_the_database_keeps_the_webhooks_until_another_file_replaces_them(tmp_path: Path, receiver: Receiver) -> None:
    home, file = tmp_path / "home", tmp_path / "hooks.json"

    def names(webhooks: str | None = None, **options: Any) -> list[str]:
        with serving(home, webhooks=webhooks, **options) as client:
            return [each["name"] for each in client.get("/api/webhooks")]

    assert names(write_webhooks(file, chat={"url": receiver.url}, log={"url": receiver.url, "queues": ["x"]})) == [
        "chat",
        "log",
    ]
    file.unlink()
    with serving(home) as client:
        job = submit_gang(client, "print(1)")
        wait_for(lambda: receiver.of(job), 20, "the message")
        ((headers, body),) = receiver.of(job)
        assert is_signed(headers, body)
        wait_for(lambda: client.get("/api/webhooks")[0]["waiting"] == 0, 20, "its acceptance")
    end_all(tmp_path)
    assert names(temporary=True) == [], "the controller of `muster run` sends none"
    assert names(write_webhooks(file, other={"url": receiver.url})) == names() == ["other"]
    assert names(write_webhooks(file)) == names() == []
