"""A server with keys, and a person at it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pytest

from orchestrator.client import Client
from orchestrator.keys import Key, KeyStore
from tests.conftest import Serving
from tests.support.console.visitor import Visitor


class Console:
    """A server with the keys ``admin``, ``reader`` (reads all) and ``lab`` (the queue ``lab`` alone); nothing of it runs any job."""

    def __init__(self, server: Serving) -> None:
        self.server, self.url, self.keys = server, server.url, KeyStore(server.home)
        made = (self.keys.create("admin"), self.keys.create("reader", None, True), self.keys.create("lab", ("lab",)))
        self.secrets = {key.name: secret_of(key) for key in made}
        self.client = Client(self.url, self.secrets["admin"])
        order = [{"order": 1, "computeEnvironment": "local"}]
        self.client.batch("CreateJobQueue", jobQueueName="lab", priority=1, computeEnvironmentOrder=order)
        self.visitors: list[Visitor] = []

    def visitor(self, name: str = "admin") -> Visitor:
        """A person with the key of this name."""
        self.visitors.append(Visitor(self.url, self.secrets[name]))
        return self.visitors[-1]

    def register(self, name: str, cpus: str = "4", command: Sequence[str] = ("true",)) -> str:
        """A definition, which by default needs more than the machine has, so that its jobs wait; returns its ARN."""
        needs = [{"type": "VCPU", "value": cpus}, {"type": "MEMORY", "value": "16"}]
        container = {"image": "muster", "command": list(command), "resourceRequirements": needs}
        properties = {
            "numNodes": 1,
            "mainNode": 0,
            "nodeRangeProperties": [{"targetNodes": "0:", "container": container}],
        }
        definition = {"jobDefinitionName": name, "type": "multinode", "nodeProperties": properties}
        return str(self.client.batch("RegisterJobDefinition", **definition)["jobDefinitionArn"])

    def submit(self, definition: str, name: str, queue: str = "default") -> str:
        """A job that waits; returns its id."""
        return str(self.client.batch("SubmitJob", jobName=name, jobQueue=queue, jobDefinition=definition)["jobId"])

    def close(self) -> None:
        for each in self.visitors:
            each.close()
        self.client.close()


def secret_of(key: Key) -> str:
    """As the login takes it."""
    return f"{key.access_key_id}:{key.secret}"


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Console]:
    """A server for the tests of one file."""
    server = Serving(tmp_path_factory.mktemp("home"), "--cpus", "1")
    console = Console(server)
    yield console
    console.close()
    server.close()
