"""A server with objects of two queues and a caller of every kind."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import httpx

from orchestrator.api.logs import operations as logs
from orchestrator.client import Client
from orchestrator.services.permissions import Operation
from orchestrator.spec.compile import compile_definition, compile_submission
from orchestrator.spec.model import validate
from shared_store import leagues
from shared_store.volume import models, texts
from shared_store.volume.bundles import seal
from shared_store.volume.checkpoints import Checkpoint
from shared_store.volume.layout import Store
from tests.conftest import Serving
from tests.support.definitions import container, multinode
from tests.support.keys import HomeKeys
from tests.support.shared_store.leagues import entry

TOKEN = "a-token-for-tests-alone"
KEYS = ("admin", "token", "robots", "lab", "reader", "robots-reader", "lab-reader")
"""The callers: keys for all queues, MUSTER_TOKEN, keys kept to the queues robots and lab, and the same three read-only."""
SECRET, MARK = "hunter2-the-secret", "robots line"


class World:
    """A server with a queue ``robots``, whose key made all that there is in it, and a queue ``lab``."""

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
        self.create_league()

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

    def create_league(self) -> None:
        """A league of the run's name with an entry of the model, both of the key ``robots``."""
        self.clients["robots"].post("/api/leagues", {"name": self.run, "track": ["oval"]})
        cup = leagues.find(Store(self.server.home / "store"), self.run)
        model = {"name": self.run, "version": 1, "digest": "0" * 64, "task": "Racer"}
        cup.enter(entry("robots", "key robots", model=model))

    def native(self, key: str, queue: str, **changes: Any) -> tuple[str, str]:
        """Submit a job from YAML; its id and its run."""
        document = {"name": "theirs", "queue": queue, "command": ["echo", MARK], "environment": {"SECRET": SECRET}}
        spec = validate({**document, "resources": {"cpus": 0.1}, **changes}, "job.yaml")
        name = self.register(key, f"native-{self.fresh()}", **compile_definition(spec, ""))
        job = self.clients[key].batch("SubmitJob", **compile_submission(spec, name))["jobId"]
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

    def native_call(self, key: str, operation: Operation, body: dict[str, Any] | None = None) -> httpx.Response:
        method, _, path = operation.partition(" ")
        path = path.format(reference=self.job, name=self.run, number=1)
        bearer = {"Authorization": f"Bearer {self.tokens[key]}"}
        return self.http.request(method, self.url + path, json=body, headers=bearer)

    def text_call(self, key: str, operation: Operation, text: str) -> httpx.Response:
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
