"""A server with keys, and persons at it: with and without a real browser."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import httpx
import pytest

from orchestrator.client import Client
from orchestrator.persistence.access_keys import Key
from tests.conftest import Serving
from tests.support.browser import launched
from tests.support.console.visitor import Visitor
from tests.support.definitions import container, multinode
from tests.support.keys import HomeKeys
from tests.support.waiting import wait_for

if TYPE_CHECKING:
    from playwright.sync_api import Browser

    from tests.support.console.person import People


class Console:
    """A server with the keys ``admin``, ``reader`` (reads all) and ``lab`` (the queue ``lab`` alone); nothing of it runs any job."""

    def __init__(self, server: Serving) -> None:
        self.server, self.url, self.keys = server, server.url, HomeKeys(server.home)
        made = (self.keys.create("admin"), self.keys.create("reader", None, True), self.keys.create("lab", ("lab",)))
        wait_for(lambda: httpx.get(f"{self.url}/api/runs").status_code == 403, what="the server's look at the keys")
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
        definition = multinode(name, container(command, cpus))
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
    with Serving(tmp_path_factory.mktemp("home"), "--cpus", "1") as server:
        console = Console(server)
        yield console
        console.close()


@pytest.fixture
def visitor(console: Console) -> Visitor:
    """A person with the key ``admin``."""
    return console.visitor()


@pytest.fixture
def chromium() -> Iterator[Browser]:
    """A browser for persons."""
    with launched() as browser:
        from playwright.sync_api import expect

        from tests.support.console.person import WAIT

        expect.set_options(timeout=WAIT)
        yield browser


@pytest.fixture
def people(chromium: Browser) -> Iterator[People]:
    """Opens browsers of persons: ``people(url, key)``. In the end none of their pages may have complained or asked anybody else."""
    from tests.support.console.person import People

    people = People(chromium)
    yield people
    people.check()
