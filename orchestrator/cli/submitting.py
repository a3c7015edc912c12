"""Submitting jobs: from the options of a command to a job that runs, and that is followed."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import typer

from orchestrator.cli.command_options import changes_of, check_engine
from orchestrator.cli.controllers import see_through
from orchestrator.cli.listings import Resource
from orchestrator.cli.progress import await_end, follow, following
from orchestrator.cli.terminal import echo, echo_json, one_line
from orchestrator.client import Client, named
from orchestrator.domain.errors import ApiError, ServerError, SpecError, Unavailable, Unreachable, UsageError
from orchestrator.home import local_url, muster_home
from orchestrator.spec import file as specfile
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.kept_files import changes_with_files
from orchestrator.spec.model import Spec
from shared_store.volume.texts import beside

_LARGEST_SPEC = 900_000
"""Characters of a spec that is sent as it is; the long texts of a larger one are sent beforehand."""

_NODES = Resource(
    {
        "NODE": "index",
        "RANK": "rank",
        "HOST": "host",
        "CPUS": lambda node: f"{node['cpus']:g}",
        "GPUS": lambda node: ",".join(node["gpus"]),
        "MEMORY": lambda node: f"{node['memory']} MiB",
        "ADDRESS": "address",
        "IMAGE": "image",
        "COMMAND": lambda node: shlex.join(node["command"]),
    },
    folded=("COMMAND",),
    whole=True,  # to be read once, and in full: a narrow terminal breaks the lines
)


def load_spec(
    path: str,
    changes: Sequence[str] | None,
    name: str | None = None,
    queue: str | None = None,
    nodes: int | None = None,
    store: Callable[[], str | None] = lambda: None,
) -> Spec:
    """The spec in a file, with the changes of options; its warnings are printed.

    Args:
        path: Of the file.
        changes: Of `--set`.
        name: Of `--name`.
        queue: Of `--queue`.
        nodes: Of `--nodes`.
        store: As of :func:`orchestrator.spec.file.load`.

    Raises:
        SpecError: The file or a change can't be used.
    """
    further = changes_of(
        changes, name=("--name", _yaml(name)), queue=("--queue", _yaml(queue)), nodes=("--nodes", nodes)
    )
    loaded = specfile.load(path, [*(changes or ()), *further], store)
    for each in loaded.notes:
        note(each)
    return loaded


def _yaml(text: str | None) -> str | None:
    return None if text is None else json.dumps(text)


def submit_spec(
    client: Client, spec: Spec, source: str, environment: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Submit a spec; refused before anything is registered if no host could ever hold it.

    Args:
        client: The controller's.
        spec: Of the job.
        source: Its name in errors.
        environment: Added on every node.

    Raises:
        SpecError: The controller refuses the spec.
        ApiError: The controller refuses the request.
        Unreachable: No controller answers.
    """
    document = spec.document()
    if len(json.dumps(document)) > _LARGEST_SPEC:
        document, texts = beside(document)
        for text in texts.values():
            client.keep_text(text)
    body = {"spec": document, "directory": os.getcwd(), "environment": dict(environment or {})}
    try:
        submitted: dict[str, Any] = client.post("/api/jobs", body, seconds=60, once=True)
    except ApiError as error:
        if error.status == 400:
            raise SpecError(f"{source}: {error}") from None
        raise
    return submitted


def report(client: Client, submitted: Mapping[str, Any], line: str, follows: bool, as_json: bool) -> None:
    """Print that a job is submitted, and follow it if requested. Raises typer.Exit with its result."""
    if as_json:
        echo_json(submitted)
    else:
        echo(line)
        if not follows:
            echo(f"follow it with: muster logs {submitted['jobId'][:8]} -f")
    if follows:
        with following(submitted["jobId"]):
            raise typer.Exit((await_end if as_json else follow)(client, submitted["jobId"]))


def carry_out(
    client: Client,
    spec: Spec,
    source: str,
    show: Callable[[Client, str], int] = follow,
    *,
    follows: bool,
    dry_run: bool,
    as_json: bool,
) -> tuple[int, str]:
    """Plan a job, submit it, or submit it and follow it to its end.

    Args:
        client: The controller's.
        spec: Of the job.
        source: Its name in errors.
        show: Follows the job; with ``as_json`` nothing is shown.
        follows: Whether the end of the job is awaited.
        dry_run: Whether it is only planned.
        as_json: Whether JSON is printed.

    Returns:
        The exit code, and the id of the job whose end was awaited; empty for no job.
    """
    if dry_run:
        plan_spec(client, spec, as_json)
        return 0, ""
    if not follows and client.is_temporary:  # it would end with this command
        raise UsageError("--no-follow: no controller is running that would supervise the job; start one: muster serve")
    submitted = submit_spec(client, spec, source)
    job = submitted["jobId"]
    if not follows:
        report(client, submitted, f"submitted {submitted['jobName']} as {job}", False, as_json)
        return 0, ""
    return see_through(client, job, await_end if as_json else show), job


def plan_spec(client: Client, spec: Spec, as_json: bool) -> None:
    """`--dry-run` of a spec that would be submitted."""
    show_plan(client, compile_definition(spec, os.getcwd()), spec.queue, as_json)


def show_plan(client: Client, definition: dict[str, Any], queue: str, as_json: bool) -> None:
    """Print what the controller's engine would start for a job definition, if all hosts were free."""
    plan = client.post("/api/plan", {"definition": definition, "queue": queue})
    if as_json:
        echo_json({**plan, "registerJobDefinition": definition}, indent=1)
        return
    echo(f"{definition['jobDefinitionName']} on the {plan['engine']} engine, queue {queue}; nothing was started")
    _NODES.show([{**node, "image": node["image"] if plan["images"] else None} for node in plan["nodes"]])
    if plan["document"]:
        echo(f"\n{plan['document']}")


def store_here(path: str | None = None) -> str | None:
    """The path of the controller's store, or else ``path`` or this home directory's; None where it is not on this machine."""
    place = Path(path).expanduser() if path else muster_home() / "store"
    if os.environ.get("MUSTER_URL") or local_url():
        try:
            with Client.connect() as client:
                return store_of(client)
        except (ServerError, Unavailable, Unreachable):
            return None
    return str(place) if place.is_dir() else None


def store_of(client: Client) -> str | None:
    """The path of the controller's store; None where it is not on this machine, or unknown."""
    try:
        place = Path(client.get("/api/capacity")["store"])
    except (ApiError, ServerError, Unavailable, Unreachable):
        return None
    return str(place) if place.is_dir() else None


def note(text: str) -> None:
    """Print a warning on standard error."""
    echo(f"note: {one_line(text)}", err=True)


def on_engine(client: Client, spec: Spec, engine: str | None, source: str) -> Spec:
    """The same spec for the queue of that engine, if one is named. Raises SpecError if the controller lacks it."""
    if engine is None:
        return spec
    queue = engine_queue(client, engine)
    if spec.queue not in ("default", queue):
        raise SpecError(f"{source}: queue: {spec.queue}, but --engine {engine} means {queue}; leave one of them out")
    return spec.model_copy(update={"queue": queue})


def engine_queue(client: Client, engine: str) -> str:
    """The queue of an engine. Raises SpecError if the controller lacks it."""
    check_engine(engine)
    queues: dict[str, str] = client.get("/api/capacity")["engines"]
    if engine not in queues:
        raise SpecError(
            f"--engine {engine}: the controller has {', '.join(queues)}; start it with: muster serve "
            + " ".join(f"--engine {name}" for name in (*queues, engine))
        )
    return queues[engine]


def queue_change(client: Client, changes: Sequence[str] | None, queue: str | None, engine: str | None) -> list[str]:
    """The change that sends a job to the queue of `--queue` or `--engine`. Raises UsageError for both, SpecError."""
    if queue is not None and engine is not None:
        raise UsageError("--queue and --engine: an engine is chosen by its queue; leave one of them out")
    queue = queue if engine is None else engine_queue(client, engine)
    return changes_of(changes, queue=("--queue or --engine", _yaml(queue)))


def changes_of_run(client: Client, run: str, changes: Sequence[str] | None, keep: Callable[[str], object]) -> list[str]:
    """`--set` changes of a run's spec, with the content of files that they name; ``keep``: is called with each long text."""
    return changes_with_files(
        lambda: client.get(f"/api/runs/{named(run)}")["spec"],
        changes,
        keep,
        partial(store_of, client),
        note,
        partial(client.run_text, run),
    )
