"""A server with objects of two queues and a caller of every kind, and what each may do there."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx

from orchestrator.api.logs import operations as logs
from orchestrator.client import Client
from orchestrator.services.permissions import HIDDEN
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.model import validate
from shared_store.volume import models, texts
from shared_store.volume.bundles import seal
from shared_store.volume.checkpoints import Checkpoint
from shared_store.volume.layout import Store
from tests.conftest import Serving
from tests.support.definitions import container, multinode, submission_of
from tests.support.keys import HomeKeys

TOKEN = "a-token-for-tests-alone"
KEYS = ("admin", "token", "robots", "lab", "reader", "robots-reader", "lab-reader")
"""The callers: keys for all queues, MUSTER_TOKEN, keys kept to the queues robots and lab, and the same three read-only."""
SECRET, MARK = "hunter2-the-secret", "robots line"

OWN_WRITE = "+ + + - - - -"
"""What belongs to the queue robots is changed: ``+`` is carried out, ``-`` is refused."""
NAMED_WRITE = "+ + + n - - -"
"""The same, found by its name: ``n`` answers as if it did not exist; a read-only key is refused before anything is looked for."""
SHARED_WRITE = "+ + - - - - -"
SHARED_READ = "+ + + + + + +"
OWN_MADE = "+ + + + - - -"
"""Something is created, which then is the caller's."""


class World:
    """A server with a queue ``robots``, whose key made everything in it, and a queue ``lab``."""

    def __init__(self, home: Path) -> None:
        kept = {"robots": ("robots",), "robots-reader": ("robots",), "lab": ("lab",), "lab-reader": ("lab",)}
        self.tokens = {"token": TOKEN}
        for name in (name for name in KEYS if name != "token"):
            key = HomeKeys(home).create(name, kept.get(name), read_only=name.endswith("reader"))
            self.tokens[name] = f"{key.access_key_id}:{key.secret}"
        os.environ["MUSTER_TOKEN"] = TOKEN
        try:
            self.server = Serving(home, "--cpus", "4")
        finally:
            del os.environ["MUSTER_TOKEN"]
        self.url, self.http = self.server.url, httpx.Client(timeout=60)
        self.clients = {name: Client(self.url, token) for name, token in self.tokens.items()}
        self.server.client = self.clients["admin"]
        admin = self.clients["admin"]
        for queue in ("robots", "lab"):
            order = [{"order": 1, "computeEnvironment": "local"}]
            admin.batch("CreateJobQueue", jobQueueName=queue, priority=1, computeEnvironmentOrder=order)
        self.counted = 0
        self.definition = self.register("robots", "theirs")
        self.job, self.run = self.native("robots", "robots")
        self.server.wait(self.job)
        self.stream = f"theirs/{self.job}/1/node-0"
        self.register_model()

    def register_model(self) -> None:
        """A model of the run's name; its spec has the secret, as a run's has."""
        store = Store(self.server.home / "store")
        run = store.run(self.run)
        bundle = run.exports / "00000001-e1"
        bundle.mkdir(parents=True)
        (bundle / "policy.onnx").write_bytes(b"weights")
        seal(bundle, {})
        checkpoint = Checkpoint(run.checkpoints / bundle.name, 1, 1)
        models.register(store, self.run, run, checkpoint, {"queue": "robots"})

    def native(self, key: str, queue: str, **changes: Any) -> tuple[str, str]:
        """Submit a job from YAML; its id and its run."""
        document = {"name": "theirs", "queue": queue, "command": ["echo", MARK], "environment": {"SECRET": SECRET}}
        spec = validate({**document, "resources": {"cpus": 0.1}, **changes}, "job.yaml")
        name = self.register(key, f"native-{self.fresh()}", **compile_definition(spec, ""))
        job = self.clients[key].batch("SubmitJob", **submission_of(spec, name))["jobId"]
        return job, f"{spec.name}-{job[:8]}"

    def register(self, key: str, name: str, **request: Any) -> str:
        """Register a definition as ``key``; its ARN."""
        request = {**definition(name), **request, "jobDefinitionName": name}
        return str(self.clients[key].batch("RegisterJobDefinition", **request)["jobDefinitionArn"])

    def fresh(self) -> str:
        self.counted += 1
        return f"made-{self.counted}"

    def made(self, operation: str, member: str, **request: Any) -> str:
        """The name of something new that admin made."""
        name = self.fresh()
        self.clients["admin"].batch(operation, **{member: name, **request})
        return name

    def send(self, key: str, operation: str, **request: Any) -> httpx.Response:
        """One of AWS's operations, as ``key``."""
        bearer = {"Authorization": f"Bearer {self.tokens[key]}"}
        if operation.endswith(("Resource", "ForResource")):
            method = {"TagResource": "POST", "UntagResource": "DELETE"}.get(operation, "GET")
            query = {"tagKeys": request.get("tagKeys", [])}
            url = f"{self.url}/v1/tags/{request['resourceArn']}"
            content = {"tags": request["tags"]} if method == "POST" else None
            return self.http.request(method, url, json=content, params=query, headers=bearer)
        if operation in logs.NAMES:
            bearer["X-Amz-Target"] = f"Logs_20140328.{operation}"
            return self.http.post(self.url, json=request, headers=bearer)
        return self.http.post(f"{self.url}/v1/{operation.lower()}", json=request, headers=bearer)

    def native_call(self, key: str, operation: str, body: dict[str, Any] | None = None) -> httpx.Response:
        method, _, path = operation.partition(" ")
        path = path.format(reference=self.job, name=self.run, number=1)
        bearer = {"Authorization": f"Bearer {self.tokens[key]}"}
        return self.http.request(method, self.url + path, json=body, headers=bearer)

    def text_call(self, key: str, operation: str, text: str) -> httpx.Response:
        """Upload a text, or read it as one of the run's."""
        digest = texts.keep(self.server.home / "store" / "runs" / self.run / "texts", text.encode())
        method, _, path = operation.partition(" ")
        bearer = {"Authorization": f"Bearer {self.tokens[key]}"}
        path = path.format(name=self.run, sha256=digest)
        return self.http.request(method, self.url + path, content=text.encode(), headers=bearer)

    def delete_key(self, key: str) -> httpx.Response:
        """Delete a key that was just made."""
        name = HomeKeys(self.server.home).create(self.fresh()).name
        bearer = {"Authorization": f"Bearer {self.tokens[key]}"}
        return self.http.delete(f"{self.url}/api/keys/{name}", headers=bearer)


def definition(name: str) -> dict[str, Any]:
    return multinode(name, container(["echo", MARK], env={"SECRET": SECRET}))


def refusal_of(answer: httpx.Response, key: str) -> None:
    reported = answer.json()
    assert (answer.status_code, reported.get("__type")) == (403, "AccessDeniedException"), (key, answer.text)
    assert f"key {key} " in reported["message"] and "\n" not in reported["message"], reported


def answers_as(row: str, world: World, operation: str, call: Callable[[str], httpx.Response], reads: bool) -> None:
    """The operation answers each of :data:`KEYS` as its row of the table says.

    Args:
        reads: Whether its answer tells of objects of the world.
    """
    for key, expected in zip(KEYS, row.split(), strict=True):
        answer = call(key)
        if key == "admin":
            full = MARK if operation == "StartLiveTail" else answer.text
        if expected == "-":
            refusal_of(answer, key)
            continue
        if expected == "n":
            assert answer.status_code == 404 and "does not exist" in answer.text, (operation, key, answer.text)
            assert "robots" not in answer.text, (operation, key, answer.text)
            continue
        assert answer.status_code in (200, 307, 400, 409), (operation, key, answer.text)  # 400, 409: of its state
        assert ('"AccessDenied"' in answer.text) is (expected == "e"), (operation, key, answer.text)
        if not reads:
            continue
        text = answer.text
        for mark in (MARK, world.job):
            if "o" in row and mark in full:
                assert (mark in text) is (expected != "o"), (operation, key, mark, text)
        if SECRET in full:
            assert expected in ("+", "h", "o"), (operation, key)
            assert (SECRET in text) is (expected == "+"), (operation, key, text)
            assert (HIDDEN in text) is (expected == "h"), (operation, key, text)
