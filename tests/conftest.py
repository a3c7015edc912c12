"""A real controller for tests: ``muster serve`` as a subprocess on a home directory of its own."""

from __future__ import annotations

import contextlib
import gc
import io
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, Self
from unittest.mock import patch as mock_patch

import pytest
from hypothesis import HealthCheck, settings

from orchestrator.cli import main
from orchestrator.client import Client
from tests.support.definitions import container, multinode
from tests.support.processes import end_all
from tests.support.suite.caches import kernel_cache
from tests.support.waiting import PATIENCE, wait_for

REPOSITORY = Path(__file__).parent.parent
pytest_plugins = [
    *(f"tests.support.{area}.fixtures" for area in ("conformance", "console", "engines", "orchestrator", "worker")),
    *(f"tests.support.suite.{part}" for part in ("costs", "lanes", "second_try")),
]
MUSTER = str(Path(sys.executable).parent / "muster")

os.environ.setdefault("WARP_CACHE_PATH", str(kernel_cache()))

# A loaded machine draws and runs examples slowly; the test is not at fault.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

# A picture at the end of each training would take a second of every one of them; test_picture.py has one made.
os.environ.setdefault("MUSTER_PICTURE", "0")


def call_muster(*arguments: str, home: Path, cwd: Path = REPOSITORY, **env: str) -> subprocess.CompletedProcess[str]:
    """Run the command in this process, a second quicker than in a new one. Its standard input is empty."""
    assert threading.current_thread() is threading.main_thread(), "it replaces what all threads share"
    output, errors = io.StringIO(), io.StringIO()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    with (
        pytest.MonkeyPatch.context() as patch,
        mock_patch.dict(os.environ, {"MUSTER_HOME": str(home), "COLUMNS": "200", **env}),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(errors),
    ):
        patch.setattr(sys, "argv", ["muster", *arguments])
        patch.setattr(sys, "stdin", io.StringIO())
        patch.chdir(cwd)
        code: int | str | None = 0
        try:
            main()
        except SystemExit as ended:
            code = ended.code
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    return subprocess.CompletedProcess(arguments, int(code or 0), output.getvalue(), errors.getvalue())


def run_muster(
    *arguments: str, home: Path, timeout: float = 120, cwd: Path = REPOSITORY, **env: str
) -> subprocess.CompletedProcess[str]:
    """The command as a process: where it brings a controller, starts a worker, or is asked from several threads."""
    return subprocess.run(
        [MUSTER, *arguments],
        env={**os.environ, "MUSTER_HOME": str(home), "COLUMNS": "200", **env},
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=timeout * PATIENCE,
    )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Write out half characters in what a test logged: the processes of a parallel run can't send them to one another."""
    report = yield
    report.sections = [(name, _written_out(text)) for name, text in report.sections]
    if _written_out(report.longreprtext) != report.longreprtext:
        report.longrepr = _written_out(report.longreprtext)
    return report


def _written_out(text: str) -> str:
    return text.encode("utf-8", "backslashreplace").decode()


class Serving:
    """A ``muster serve`` subprocess. ``with`` closes it."""

    command: tuple[str, ...] = (MUSTER,)
    token: str | None = None
    errors: Path | None = None
    """Where its standard error is kept: a pipe by default."""

    def __init__(self, home: Path, *options: str) -> None:
        self.home, self.options = home, options
        self.start()

    def start(self) -> None:
        env = {**os.environ, "MUSTER_HOME": str(self.home), **({"MUSTER_TOKEN": self.token} if self.token else {})}
        with open(self.errors or os.devnull, "ab") as errors:
            self.process = subprocess.Popen(
                [*self.command, "serve", "--port", "0", *self.options],
                env=env,
                stdout=subprocess.PIPE,
                stderr=errors if self.errors else subprocess.PIPE,
                text=True,
            )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("Muster serves "), line + self._complaint()
        self.url = line.split()[2]
        self.client = Client(self.url, self.token)

    def _complaint(self) -> str:
        assert self.process.stderr is not None or self.errors is not None
        return self.errors.read_text() if self.errors else self.process.stderr.read()  # type: ignore[union-attr]

    def kill(self) -> None:
        """SIGKILL, as a crash would end it."""
        self.process.kill()
        self.process.wait()

    def muster(self, *arguments: str, **env: Any) -> subprocess.CompletedProcess[str]:
        return call_muster(*arguments, home=self.home, **env)

    def muster_process(self, *arguments: str, timeout: float = 120) -> subprocess.CompletedProcess[str]:
        return run_muster(*arguments, home=self.home, timeout=timeout)

    def gang(self, script: str, nodes: int = 1, name: str = "test", **container: Any) -> str:
        """Submit ``script`` (Python) as a gang with plain Batch requests; returns the job id. ``env``: environment."""
        return submit_gang(self.client, script, nodes, name, **container)

    def detail(self, job: str) -> dict[str, Any]:
        detail: dict[str, Any] = self.client.get(f"/api/jobs/{job}")
        return detail

    def wait(self, job: str, *statuses: str, timeout: float = 60) -> dict[str, Any]:
        """The job's detail, once it is in one of ``statuses`` (by default, over)."""
        requested = statuses or ("SUCCEEDED", "FAILED")

        def existing() -> dict[str, Any] | None:
            detail = self.detail(job)
            return detail if detail["status"] in requested else None

        found: dict[str, Any] = wait_for(existing, timeout, f"job {job} {requested}")
        return found

    def log(self, job: str, **query: Any) -> list[str]:
        return [line["text"] for line in self.client.logs(job, **query)]

    def close(self) -> None:
        """End the server, and whatever a failed test left running."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.wait(10 * PATIENCE)
        self.client.close()
        end_all(self.home)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


MAIN_LAST = """
import os, pathlib, time
_here = pathlib.Path(os.environ["MUSTER_STORE"]).parent / "ends" / os.environ["AWS_BATCH_JOB_ID"].split("#")[0]
_here.mkdir(parents=True, exist_ok=True)
(_here / os.environ["RANK"]).touch()
while os.environ["RANK"] == "0" and len(list(_here.iterdir())) < int(os.environ["WORLD_SIZE"]): time.sleep(0.01)
"""
"""Last lines of a gang's script: the main node, whose end ends the others wherever they are, waits for them to come here too."""


def submit_gang(
    client: Client,
    script: str,
    nodes: int = 1,
    name: str = "test",
    *,
    env: dict[str, str] | None = None,
    cpus: str = "0.1",
    attempts: int = 1,
    timeout: int | None = None,
    queue: str = "default",
) -> str:
    """Register and submit a Python script as a multi-node job; returns the job id."""
    needs = container(["python", "-u", "-c", script], cpus, env)
    definition = multinode(name, needs, nodes, retryStrategy={"attempts": attempts})
    if timeout:
        definition["timeout"] = {"attemptDurationSeconds": timeout}
    registered = client.batch("RegisterJobDefinition", **definition)
    submitted = client.batch("SubmitJob", jobName=name, jobQueue=queue, jobDefinition=registered["jobDefinitionArn"])
    return str(submitted["jobId"])


@pytest.fixture(autouse=True, scope="session")
def nothing_is_frozen() -> Iterator[None]:
    """What a training freezes when it begins would outlast its test, with its open files."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gc, "freeze", lambda: None)
        yield


@pytest.fixture(scope="session")
def shared_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    """One server for the tests that neither kill it nor fill it."""
    with Serving(tmp_path_factory.mktemp("home"), "--cpus", "8") as server:
        yield server


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Serving]:
    """A server of the test's own."""
    with Serving(tmp_path / "home", "--cpus", "4") as server:
        yield server
