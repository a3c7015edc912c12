"""The controller that a command finds, or is for as long as its job runs."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from orchestrator.cli.progress import follow, following
from orchestrator.cli.terminal import echo
from orchestrator.client import Client
from orchestrator.domain.errors import NotServing, ServerError, Unreachable
from orchestrator.home import ControllerRuns, local_url, muster_home


def see_through(client: Client, job: str, follow: Callable[[Client, str], int] = follow) -> int:
    """Follow a job to its end; Ctrl-C and SIGTERM stop it after a checkpoint. Returns the command's exit code."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with following(job):
            return follow(client, job)
    except KeyboardInterrupt:
        echo("\nstopping: the job checkpoints and exits (Ctrl-C again: leave it running)", err=True)
        client.batch("TerminateJob", jobId=job, reason="stopped with Ctrl-C")
        follow(client, job)
        return 130


@contextlib.contextmanager
def controller(store: str | None, cpus: float | None, engines: Sequence[str] = ()) -> Iterator[Callable[[], Client]]:
    """A function that connects to the controller of this home directory, or starts one if none is running."""
    with contextlib.ExitStack() as stack:

        def connect() -> Client:
            client = stack.enter_context(_controller(store, cpus, engines))
            # a service comes back by itself, with its own options; none of this command's may take its place
            client.successor = connect if client.is_temporary else None
            return client

        yield connect


@contextlib.contextmanager
def found_or_own(store: str | None, cpus: float | None, engines: Sequence[str] = ()) -> Iterator[tuple[Client, bool]]:
    """A client of this home directory's controller, and whether this command started that, since none was running.

    One is started only where there may be runs: with a given store, or in a home directory that a controller had. Raises Unreachable,
    ServerError.
    """
    is_own = not os.environ.get("MUSTER_URL") and local_url() is None
    if is_own and store is None and not (muster_home() / "muster.db").is_file():
        Client.connect()  # raises Unreachable, with what to do
    if is_own and store is not None and not (Path(store).expanduser() / "store.json").is_file():
        raise ServerError(f"--store {store}: not a store (no store.json), so it has no run; name the store of the run")
    with controller(store, cpus, engines) as connect:
        client = connect()
        yield client, is_own and not client.found  # else another one was starting


@contextlib.contextmanager
def _controller(store: str | None, cpus: float | None, engines: Sequence[str]) -> Iterator[Client]:
    """A client of the controller that serves this home directory, or of a new one in this process."""
    url = os.environ.get("MUSTER_URL") or local_url()
    if url:
        with contextlib.ExitStack() as stack:
            try:
                client = stack.enter_context(Client.connect(serving=True))
                used = client.get("/api/capacity")["store"]
            except NotServing:
                raise
            except Unreachable:
                if os.environ.get("MUSTER_URL"):
                    raise
            else:
                if store is not None and str(Path(store).expanduser().absolute()) != used:
                    raise ServerError(
                        f"--store {store}: the controller at {url} uses store {used}; leave --store out, or stop it"
                    )
                yield client
                return
    from orchestrator.server import Server

    try:
        server = Server(muster_home(), store=store, cpus=cpus, engines=engines or ("local",), temporary=True)
    except ControllerRuns as error:
        if local_url() not in (None, url):  # it was starting
            with _controller(store, cpus, engines) as client:
                yield client
            return
        if url is None:
            raise
        raise Unreachable(
            f"the controller at {url} does not answer: it may be frozen or busy; its jobs run on"
        ) from error
    server.start()
    try:
        with Client(server.url, server.access.own_token) as client:  # it may require a key that this command lacks
            client.is_temporary = True
            yield client
    finally:
        server.close()
