"""The live view of a training inside the page of its job: `muster view` on the server's machine, in a frame.

The viewer has an origin of its own on loopback, since Rerun's page needs inline scripts, which the console's policy forbids. A browser
on another machine does not reach it; its page says so and names the command.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from importlib.util import find_spec
from urllib.parse import urlsplit

from fastapi import Request, Response

from orchestrator.api.http.request_head import is_loopback
from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native.routes import job_detail
from orchestrator.console.forms import done
from orchestrator.console.routing import page_router
from orchestrator.domain.errors import ClientError
from orchestrator.services.chosen_checkpoints import CONFLICT
from orchestrator.services.context import permitted_run
from orchestrator.services.permissions import Operation
from shared_store.process.tether import start_tied

router = page_router()

_MOST = 2
"""Views at once on a server: each takes a share of a processor and some 0.8 GB of memory."""
_UNSEEN = 300.0
"""A view ends after this time without a visitor on its job's page [s]."""
_AT = "the view is at "
"""The words of `muster view` before its address."""


@dataclass(frozen=True)
class JobViewState:
    """The state of one job's view; at most one field is filled."""

    is_starting: bool = False
    url: str = ""
    problem: str = ""
    """The reason for which the last view ended."""

    @property
    def text(self) -> str:
        """A different text for each state."""
        return "starting" if self.is_starting else self.url or self.problem


@dataclass
class _View:
    command: list[str]
    state: JobViewState = field(default_factory=lambda: JobViewState(is_starting=True))
    seen: float = field(default_factory=time.monotonic)
    is_needed: bool = True

    def run(self) -> None:
        """Run the viewer until it ends; it dies with this thread, however the server ends."""
        lines: deque[str] = deque(maxlen=5)
        process = start_tied(
            self.command,
            [signal.SIGHUP],  # the server's terminal is closed, and `nohup` keeps the server
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        threading.Thread(target=self._watch, args=[process], daemon=True).start()
        assert process.stdout is not None
        for raw in process.stdout:
            line = raw.decode(errors="replace").strip()
            if line.startswith(_AT):
                self.state = JobViewState(url=line.removeprefix(_AT))
            elif line:
                lines.append(line)
        code = process.wait()
        last = lines[-1].removeprefix("muster: ") if lines else f"exit code {code}"
        self.state = JobViewState(problem=last[:500] if self.is_needed and code else "")

    def _watch(self, process: subprocess.Popen[bytes]) -> None:
        """End the viewer once it is not needed, or nobody has looked for long."""
        while process.poll() is None:
            self.is_needed = self.is_needed and time.monotonic() - self.seen <= _UNSEEN
            if not self.is_needed:
                process.terminate()
            time.sleep(0.2)


class Views:
    """The views of a server's jobs. Any thread may call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._views: dict[str, _View] = {}

    def state(self, job: str, *, is_seen: bool = False) -> JobViewState:
        """The state of the job's view; ``is_seen``: a visitor has the job's page open."""
        if (view := self._views.get(job)) is None:
            return JobViewState()
        if is_seen:
            view.seen = time.monotonic()
        return view.state

    def start(self, job: str, command: list[str]) -> None:
        """Start the view of a job that has none. Raises ClientError where too many are open."""
        with self._lock:
            running = [name for name, view in self._views.items() if view.state.is_starting or view.state.url]
            if job in running:
                return
            if len(running) >= _MOST:
                raise ClientError(f"{_MOST} live views are open on this server; close one first", CONFLICT)
            self._views = {name: self._views[name] for name in running}
            view = self._views[job] = _View(command)
        threading.Thread(target=view.run, name=f"viewer {job}", daemon=True).start()

    def end(self, job: str) -> None:
        """Close the job's view, where it has one."""
        if (view := self._views.get(job)) is not None:
            view.is_needed = False


views = Views()


@router.post("/jobs/{reference}/view")
def show(request: Request, reference: str) -> Response:
    """Start the live view of a training that runs on this machine."""
    detail = job_detail(request, reference)
    if not is_near(request):
        raise ClientError("the live view is available only on the server's machine; open the console there", CONFLICT)
    if detail["kind"] != "train" or detail["status"] != "RUNNING":
        raise ClientError(f"job {detail['name']} is not a running training; its checkpoints can be recorded", CONFLICT)
    if find_spec("newton") is None:
        raise ClientError("the live view needs the simulation on this machine: pip install 'muster[worker]'", CONFLICT)
    run = permitted_run(controller_of(request), actor_of(request), detail["run"], Operation.READ_RUN)
    module = [sys.executable, "-P", "-m", "worker.telemetry.live_view"]
    options = {"training": str(run.path), "job": detail["id"], "port": "0", "framed-by": _origin(request)}
    views.start(detail["id"], [*module, *(each for name, value in options.items() for each in (f"--{name}", value))])
    return done(request, f"/jobs/{detail['id']}", "the live view is starting")


@router.post("/jobs/{reference}/view/close")
def close(request: Request, reference: str) -> Response:
    """Close the live view of a job."""
    detail = job_detail(request, reference)
    views.end(detail["id"])
    return done(request, f"/jobs/{detail['id']}", "the live view is closed")


def is_near(request: Request) -> bool:
    """Whether the browser names this machine as its own, so that it reaches other ports of loopback too."""
    try:
        return is_loopback(_host(request)[0])
    except ValueError:
        return False


def _origin(request: Request) -> str:
    """The console's origin as the browser has it, made anew of its parts: it becomes a part of the viewer's policy."""
    name, port = _host(request)
    return f"{request.url.scheme}://{f'[{name}]' if ':' in name else name}:{port}"


def _host(request: Request) -> tuple[str, int]:
    """Name and port in the address of the console. Raises ValueError where it is malformed."""
    parts = urlsplit(f"//{request.headers.get('host', '')}")
    return parts.hostname or "", parts.port or (443 if request.url.scheme == "https" else 80)
