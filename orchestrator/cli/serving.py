"""``muster run`` and ``muster serve``: the commands that own a controller."""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Sequence
from math import inf
from typing import Annotated

import typer

from orchestrator.cli import command_options as options
from orchestrator.cli.controllers import controller
from orchestrator.cli.progress import outcome
from orchestrator.cli.submitting import carry_out, load_spec, note, on_engine, store_here
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.control.disk import DEFAULT, MinFree
from orchestrator.domain.errors import SpecError, UsageError
from orchestrator.domain.retention import rule_of
from orchestrator.engines.toolkit.environment import INHERIT, PRIVATE
from orchestrator.home import muster_home
from orchestrator.spec.values import seconds_of

EnginesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--engine",
        metavar="ENGINE",
        help="Engine that runs the nodes: local (the default: processes on this machine), docker (containers of the job's image), ray, "
        "slurm or aws-batch. Repeatable: the first gets the queue default, each other one a queue that has its name. An engine with "
        "unfinished jobs in the queue default keeps it.",
    ),
]
InheritOption = Annotated[
    list[str] | None,
    typer.Option(
        "--inherit",
        metavar="NAME",
        envvar=INHERIT,
        help="Variable that jobs get, too, such as WANDB_API_KEY: of this environment (local, slurm), of the node's (ray). Repeatable.",
        show_envvar=False,
    ),
]
_SHORTEST_SILENCE = 10.0
_SHORTEST_INTERVAL, _LONGEST_INTERVAL = 1.0, 240.0
"""Seconds between two calls of squeue: slurmctld forgets an ended job after 300 s by default (MinJobAge)."""


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster run job_specs/cartpole.yaml --set train.iterations=100")(run)
    app.command(epilog="Examples:  muster serve --store /mnt/efs/muster;  muster serve --inherit WANDB_API_KEY")(serve)


def run(
    spec: options.SpecArgument,
    set_: options.SetOption = None,
    name: options.NameOption = None,
    queue: options.QueueOption = None,
    engine: EnginesOption = None,
    nodes: options.NodesOption = None,
    store: options.StoreOption = None,
    cpus: options.CpusOption = None,
    inherit: InheritOption = None,
    follow_: options.FollowOption = True,
    dry_run: options.DryRunOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Run a job to its end, with a temporary controller if none is running.

    It exits with the job's result. Ctrl-C stops the job after a checkpoint; a second Ctrl-C leaves it running.
    """
    loaded = load_spec(spec, set_, name, queue, nodes, lambda: store_here(store))
    have_inherited(inherit)
    for each in engine or ():
        options.check_engine(each)
    with controller(store, cpus, engine or ()) as connect:
        client = connect()
        if inherit and (client.found or os.environ.get("MUSTER_URL")):
            note(f"--inherit: the controller at {client.url} runs already; its own --inherit says what jobs get")
        loaded = on_engine(client, loaded, engine[0] if engine else None, spec)
        code, job = carry_out(client, loaded, spec, follows=follow_, dry_run=dry_run, as_json=as_json)
        if as_json and job:
            echo_json(outcome(client.get(f"/api/jobs/{job}")), indent=1)
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


def serve(
    host: Annotated[
        str,
        typer.Option(
            metavar="ADDRESS",
            help="Address to listen on; any but loopback requires a key (muster keys) or MUSTER_TOKEN.",
        ),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0: any free port.")] = 8080,
    store: options.StoreOption = None,
    adopt_store: Annotated[
        bool,
        typer.Option("--adopt-store", help="Use the store at this path although the controller knows another one."),
    ] = False,
    cpus: options.CpusOption = None,
    engine: EnginesOption = None,
    database: options.DatabaseOption = None,
    retention: Annotated[
        str | None,
        typer.Option(
            metavar="DURATION|off",
            help="Time to keep ended jobs, their logs, and runs that hold nothing else, such as 90d; off: without end. By default 90d for "
            "jobs of the Batch API, without end for others; a queue's tag muster:retention takes precedence.",
        ),
    ] = None,
    min_free: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE|PERCENT",
            help="Free space of store and database below which no gang starts: 1GiB or 5%; 0: no limit. By default 1GiB, or 5% of a "
            "small volume.",
        ),
    ] = None,
    lost_after: Annotated[
        str,
        typer.Option(
            metavar="DURATION",
            help="Time after which a node is lost that alone is silent on the bus, such as 5m, while its engine says that it runs. Nodes "
            "that fall silent together are waited for, since the controller may be cut off.",
        ),
    ] = "120s",
    squeue_interval: Annotated[
        str | None,
        typer.Option(
            metavar="DURATION",
            help="Time between two calls of squeue, such as 60s. By default 1s with at most 10 gangs, else 30s.",
        ),
    ] = None,
    rate_limit: Annotated[
        int, typer.Option(min=0, help="Requests per second of each key, with bursts of twice as many; 0: unlimited.")
    ] = 1000,
    trust_proxy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ADDRESS",
            help="Address or network of a reverse proxy whose X-Forwarded-For and X-Forwarded-Proto are trusted. Repeatable.",
        ),
    ] = None,
    submit_rate_limit: Annotated[
        int, typer.Option(min=0, help="Submissions per second of each key (AWS: 50); 0: unlimited.")
    ] = 0,
    secrets: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|env",
            help="Source of the secrets that jobs name: a JSON file of names and values, or env for variables MUSTER_SECRET_<name>. By "
            "default such jobs are refused.",
        ),
    ] = None,
    webhooks: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="JSON file of webhooks, which replaces those in the database; see `muster webhooks --help`.",
        ),
    ] = None,
    account_id: Annotated[
        str | None,
        typer.Option(
            metavar="ACCOUNT",
            help="AWS account in all ARNs, 12 digits. The first `muster serve` settles it; default: zeros.",
        ),
    ] = None,
    region: Annotated[
        str | None,
        typer.Option(
            metavar="REGION", help="AWS region in all ARNs. The first `muster serve` settles it; default: us-east-1."
        ),
    ] = None,
    inherit: InheritOption = None,
) -> None:
    """Run the controller as a server. Running jobs outlive it.

    The next controller finds them.
    """
    from orchestrator.server import Server  # imports dependencies of the controller only
    from orchestrator.service_manager import ServiceManager

    manager = ServiceManager()
    have_inherited(inherit)
    for name in engine or ():
        options.check_engine(name)
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
    manager.notify("READY=1")
    manager.keep_alive(lambda: server.controller.monitoring.loop_problem() is None, ended.wait)
    try:
        while not ended.wait(1.0):  # Python sees a signal that another thread took when this one wakes
            pass
    finally:
        manager.notify("STOPPING=1")
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


def _min_free(text: str | None) -> MinFree:
    try:
        return MinFree.parse(text) if text else DEFAULT
    except ValueError as error:
        raise SpecError(f"--min-free {text}: {error}") from None


def _retention(text: str | None) -> float | None:
    """Seconds; infinity for ``off``."""
    if text is None:
        return None
    try:
        age = rule_of(text)
    except ValueError as error:
        raise SpecError(f"--retention: {error}") from None
    return inf if age is None else age / 1000
