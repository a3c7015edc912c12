"""``muster run`` and ``muster serve``: the commands that own a controller."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from math import inf
from pathlib import Path
from typing import Annotated

import typer

from orchestrator.cli.jobs import (
    SetOption,
    SpecArgument,
    check_engine,
    on_engine,
    store_here,
    submit_spec,
    tell,
    tell_note,
)
from orchestrator.cli.progress import follow
from orchestrator.cli.terminal import echo
from orchestrator.client import Client
from orchestrator.control.disk import DEFAULT, MinFree
from orchestrator.domain.errors import NotServing, ServerError, SpecError, Unreachable, UsageError
from orchestrator.domain.retention import rule_of
from orchestrator.engines.toolkit.environment import INHERIT, PRIVATE
from orchestrator.home import ControllerRuns, local_url, muster_home
from orchestrator.spec import file as specfile
from orchestrator.spec.values import seconds_of

StoreOption = Annotated[str | None, typer.Option(help="Directory of the shared store; $MUSTER_HOME/store by default.")]
EngineOption = Annotated[
    list[str] | None,
    typer.Option(
        help="Engine that runs the nodes: local (the default: processes on this machine), docker (containers of the job's image), ray, "
        "slurm or aws-batch. Repeatable: the first gets the queue default, each other one a queue that has its name. An engine whose jobs in the "
        "queue default are not over keeps it."
    ),
]
_SHORTEST_SILENCE = 10.0
_SHORTEST_INTERVAL, _LONGEST_INTERVAL = 1.0, 240.0
"""Seconds between two calls of squeue: slurmctld forgets an ended job after 300 s by default (MinJobAge)."""
CpusOption = Annotated[
    float | None, typer.Option(min=0.1, help="CPU cores to allocate; by default all of the machine's.")
]

InheritOption = Annotated[
    list[str] | None,
    typer.Option(
        "--inherit",
        metavar="NAME",
        envvar=INHERIT,
        help="Variable that jobs get, too, such as WANDB_API_KEY: of this environment (local, slurm), of the node's (ray). Repeatable.",
        show_default=False,
        show_envvar=False,
    ),
]


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster run job_specs/cartpole.yaml --set train.iterations=100")(run)
    app.command(epilog="Examples:  muster serve --store /mnt/efs/muster;  muster serve --inherit WANDB_API_KEY")(serve)


def run(
    spec: SpecArgument,
    set_: SetOption = None,
    store: StoreOption = None,
    cpus: CpusOption = None,
    engine: EngineOption = None,
    inherit: InheritOption = None,
) -> None:
    """Run a job to its end, with a temporary controller if none is running; exit with its result.

    Ctrl-C stops the job after a checkpoint; a second Ctrl-C leaves it running.
    """
    loaded = specfile.load(spec, set_, lambda: store_here(store))
    tell(loaded)
    have_inherited(inherit)
    for name in engine or ():
        check_engine(name)
    with controller(store, cpus, engine or ()) as connect:
        client = connect()
        if inherit and (client.found or os.environ.get("MUSTER_URL")):
            tell_note(f"--inherit: the controller at {client.url} runs already; its own --inherit says what jobs get")
        if engine:
            loaded = on_engine(client, loaded, engine[0], spec)
        job = submit_spec(client, loaded, spec)["jobId"]
        code = see_through(client, job)
    raise typer.Exit(code)


def have_inherited(names: Sequence[str] | None) -> None:
    """Let jobs have these variables of this process. Raises UsageError for a name that no variable can have, and for the controller's own."""
    for name in names or ():
        if not name.isidentifier():
            raise UsageError(
                f"--inherit, or {INHERIT}: {name[:100]}: give the name of a variable, such as WANDB_API_KEY"
            )
        if name in PRIVATE:
            raise UsageError(
                f"--inherit, or {INHERIT}: {name} is the controller's own; jobs get credentials by secrets: in their YAML"
            )
    os.environ[INHERIT] = " ".join(names or ())


def see_through(client: Client, job: str, follow: Callable[[Client, str], int] = follow) -> int:
    """Follow a job to its end; Ctrl-C and SIGTERM stop it after a checkpoint. Returns the command's exit code."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return follow(client, job)
    except KeyboardInterrupt:
        echo("\nstopping: the job checkpoints and exits (Ctrl-C again: leave it running)", err=True)
        client.batch("TerminateJob", jobId=job, reason="stopped with Ctrl-C")
        follow(client, job)
        return 130


def serve(
    host: Annotated[
        str, typer.Option(help="Address to listen on; any but loopback requires a key (muster keys) or MUSTER_TOKEN.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0: any free port.")] = 8080,
    store: StoreOption = None,
    adopt_store: Annotated[
        bool,
        typer.Option(
            "--adopt-store",
            help="Take what is at the store's path as the store of this controller, which knows another one.",
        ),
    ] = False,
    cpus: CpusOption = None,
    engine: EngineOption = None,
    database: Annotated[
        str | None,
        typer.Option(
            envvar="MUSTER_DATABASE",
            help="postgresql+psycopg://USER@HOST/NAME, or path of an SQLite file on a local disk; $MUSTER_HOME/muster.db by default.",
        ),
    ] = None,
    retention: Annotated[
        str | None,
        typer.Option(
            help="Time to keep ended jobs, their logs, and runs that hold nothing else, such as 90d; off: without end. By "
            "default jobs of the Batch API are kept for 90d, others without end; the tag muster:retention of a queue takes precedence.",
            show_default=False,
        ),
    ] = None,
    min_free: Annotated[
        str,
        typer.Option(
            help="Free space on the volumes of the store and the database below which no gang starts, such as 1GiB or 5%; 0: "
            "no limit. By default 1GiB, or 5% of a small volume.",
            show_default=False,
        ),
    ] = "",
    lost_after: Annotated[
        str,
        typer.Option(
            help="Time after which a node that alone is silent on the bus is lost, such as 5m, while its engine answers and says that "
            "it runs. The controller waits for nodes that fall silent together, since it may itself be cut off."
        ),
    ] = "120s",
    squeue_interval: Annotated[
        str | None,
        typer.Option(
            help="Time between two calls of squeue by the slurm engine, such as 60s. By default 1s with at most 10 gangs in Slurm's "
            "queue, and 30s with more.",
            show_default=False,
        ),
    ] = None,
    rate_limit: Annotated[
        int,
        typer.Option(min=0, help="Requests per second of each key, with bursts of twice as many; 0: unlimited."),
    ] = 1000,
    trust_proxy: Annotated[
        list[str] | None,
        typer.Option(
            help="Address or network of a reverse proxy whose X-Forwarded-For and X-Forwarded-Proto are trusted; repeatable. "
            "None by default."
        ),
    ] = None,
    submit_rate_limit: Annotated[
        int,
        typer.Option(
            min=0, help="Submissions (SubmitJob, POST /api/jobs) per second of each key (AWS: 50); 0: unlimited."
        ),
    ] = 0,
    secrets: Annotated[
        str | None,
        typer.Option(
            help="Source of the secrets that job definitions name: a JSON file of names and values, or env for the variables "
            "MUSTER_SECRET_<name>. Jobs that name secrets are refused by default."
        ),
    ] = None,
    webhooks: Annotated[
        str | None,
        typer.Option(
            help="Send a message when jobs end: a JSON file of URLs and secrets, which replace those of the database; see `muster "
            "webhooks --help`. By default the database's."
        ),
    ] = None,
    account_id: Annotated[
        str | None,
        typer.Option(
            help="AWS account in all ARNs, 12 digits; 000000000000 by default. The first `muster serve` settles it.",
            show_default=False,
        ),
    ] = None,
    region: Annotated[
        str | None,
        typer.Option(
            help="AWS region in all ARNs; us-east-1 by default. The first `muster serve` settles it. Nothing runs there.",
            show_default=False,
        ),
    ] = None,
    inherit: InheritOption = None,
) -> None:
    """Run the controller as a server. Running jobs outlive it; the next controller finds them."""
    from orchestrator.server import Server  # imports dependencies of the controller only
    from orchestrator.service_manager import ServiceManager

    manager = ServiceManager()
    have_inherited(inherit)
    for name in engine or ():
        check_engine(name)
    server = Server(
        muster_home(),
        host=host,
        port=port,
        store=store,
        adopt_store=adopt_store,
        token=os.environ.get("MUSTER_TOKEN"),
        cpus=cpus,
        engines=engine or ("local",),
        rate_limit=rate_limit,
        submit_rate_limit=submit_rate_limit,
        database=database,
        retention=_retention(retention),
        secrets=secrets,
        trusted_proxies=trust_proxy or (),
        min_free=_min_free(min_free),
        lost_after=_lost_after(lost_after),
        squeue_interval=_squeue_interval(squeue_interval, engine or ()),
        webhooks=webhooks,
        account=account_id,
        region=region,
    )
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda _number, _frame: ended.set())
    server.start()
    echo(f"Muster serves {server.url}  (API: {server.url}/api/docs)")
    if host in ("0.0.0.0", "::"):
        echo(f"on all interfaces: from other machines http://{socket.gethostname()}:{server.url.rpartition(':')[2]}")
    echo(server.access.admitted())
    echo(f"home {muster_home()}, store {server.store.path}")
    manager.tell("READY=1")
    manager.keep_alive(lambda: server.controller.monitoring.loop_problem() is None, ended.wait)
    try:
        while not ended.wait(1.0):  # Python sees a signal that another thread took when this one wakes
            pass
    finally:
        manager.tell("STOPPING=1")
        server.close()
    echo("stopped; running jobs continue and the next `muster serve` finds them")


def _lost_after(text: str) -> float:
    seconds = seconds_of("--lost-after", text)
    if seconds is None or seconds < _SHORTEST_SILENCE:
        raise SpecError(
            f"--lost-after {text!r}: expected at least {_SHORTEST_SILENCE:.0f}s; a busy machine is silent for some seconds"
        )
    return seconds


def _squeue_interval(text: str | None, engines: Sequence[str]) -> float | None:
    seconds = seconds_of("--squeue-interval", text)
    if seconds is None:
        return None
    from orchestrator.engines.installed import traits_of

    if not any(traits_of(name).squeue for name in engines):
        raise SpecError(
            f"--squeue-interval {text}: only the slurm engine calls squeue; add --engine slurm, or leave it out"
        )
    if not _SHORTEST_INTERVAL <= seconds <= _LONGEST_INTERVAL:
        raise SpecError(f"--squeue-interval {text}: expected {_SHORTEST_INTERVAL:.0f}s to {_LONGEST_INTERVAL:.0f}s")
    return seconds


def _min_free(text: str) -> MinFree:
    try:
        return MinFree.parse(text) if text else DEFAULT
    except ValueError as error:
        raise SpecError(f"--min-free {text}: {error}") from None


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

    One is started only where there may be runs: with a given store, or in a home directory that a controller had. Raises Unreachable, ServerError.
    """
    is_own = not os.environ.get("MUSTER_URL") and local_url() is None
    if is_own and store is None and not (muster_home() / "muster.db").is_file():
        Client.connect()  # raises Unreachable, with what to do
    if is_own and store is not None and not (Path(store).expanduser() / "store.json").is_file():
        raise ServerError(
            f"--store {store}: there is no store here (no store.json), so no run; name the store of the run"
        )
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
                there = client.get("/api/capacity")["store"]
            except NotServing:
                raise
            except Unreachable:
                if os.environ.get("MUSTER_URL"):
                    raise
            else:
                if store is not None and str(Path(store).expanduser().absolute()) != there:
                    raise ServerError(
                        f"--store {store}: the controller at {url} keeps {there}; leave --store out, or stop it"
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


def _retention(text: str | None) -> float | None:
    """Seconds; infinity for ``off``."""
    if text is None:
        return None
    try:
        age = rule_of(text)
    except ValueError as error:
        raise SpecError(f"--retention: {error}") from None
    return inf if age is None else age / 1000
