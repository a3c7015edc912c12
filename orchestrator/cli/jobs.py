"""Commands for jobs: ``muster submit``, ``stop``, ``checkpoint``, ``stacks``, ``schema``."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.plans import show_plan
from orchestrator.cli.progress import follow
from orchestrator.cli.terminal import echo, echo_json, one_line
from orchestrator.client import Client, named
from orchestrator.domain import reasons
from orchestrator.domain.errors import ApiError, ServerError, SpecError, Unavailable, Unreachable
from orchestrator.domain.job import TERMINAL
from orchestrator.engines.installed import ENGINES
from orchestrator.home import local_url, muster_home
from orchestrator.spec import file as specfile
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.json_schema import contract_schema, schema
from orchestrator.spec.model import Spec
from shared_store.contract.error_text import counted, nearest
from shared_store.volume.texts import beside

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]
AcceptOption = Annotated[
    bool,
    typer.Option(
        "--accept-changed-robot", help="Go on where the robot's file loads otherwise than in the policy's training."
    ),
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="Change a key of the spec: train.iterations=600. Repeatable.")
]
SpecArgument = Annotated[str, typer.Argument(help="A job YAML, such as job_specs/cartpole.yaml.")]
JobArgument = Annotated[
    str,
    typer.Argument(
        help="Job id or its first letters (4 or more), or a job name (your newest of it, else the newest); with :INDEX, an array's child."
    ),
]

_EXAMPLES = """Examples:  muster submit job_specs/ant.yaml --set train.iterations=600 -f
muster submit job_specs/ant.yaml --name ant-2 --set train.seed=2 --dry-run"""
_LARGEST_SPEC = 900_000
"""Characters of a spec that is sent as it is; the long texts of a larger one are sent beforehand."""
_PATIENCE = 3.0
"""Seconds after which a slow stop explains itself."""


def register(app: typer.Typer) -> None:
    app.command(epilog=_EXAMPLES)(submit)
    app.command(epilog="Example:  muster stop ant   then   muster resume RUN")(stop)
    app.command(epilog="Example:  muster checkpoint ant")(checkpoint)
    app.command(epilog="Example:  muster stacks ant > stacks.txt")(stacks)
    app.command("schema", epilog="Example:  muster schema > muster.schema.json     or:  muster schema --contract")(
        print_schema
    )


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
        answer: dict[str, Any] = client.post("/api/jobs", body, seconds=60, once=True)
    except ApiError as error:
        if error.status == 400:
            raise SpecError(f"{source}: {error}") from None
        raise
    return answer


def submit(
    spec: SpecArgument,
    set_: SetOption = None,
    follow_: Annotated[bool, typer.Option("--follow", "-f", help="Show progress until the job ends.")] = False,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Show what would start where, without starting it; --json: with all variables."),
    ] = False,
    engine: Annotated[
        str | None,
        typer.Option(help=f"Engine that runs the job, one of the controller's: {', '.join(ENGINES)}."),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Of the job, and of its run, instead of the spec's.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Submit a job to a running controller.

    Of the machine's environment it gets what programs need, and what `muster serve --inherit NAME` names; environment: of the YAML adds values.
    """
    loaded = specfile.load(spec, [*(set_ or ()), *called(set_, name)], store_here)
    tell(loaded)
    with Client.connect() as client:
        if engine is not None:
            loaded = on_engine(client, loaded, engine, spec)
        if dry_run:
            show_plan(client, compile_definition(loaded, os.getcwd()), loaded.queue, as_json)
            return
        submitted = submit_spec(client, loaded, spec)
        if as_json:
            echo_json(submitted)
        else:
            echo(f"submitted {submitted['jobName']} as {submitted['jobId']}")
            if not follow_:
                echo(f"follow it with: muster logs {submitted['jobId'][:8]} -f")
        if follow_:
            raise typer.Exit(follow(client, submitted["jobId"]))


def store_here(named: str | None = None) -> str | None:
    """The path of the controller's store, or else of ``named`` or this home directory's; None where it is not on this machine."""
    place = Path(named).expanduser() if named else muster_home() / "store"
    if os.environ.get("MUSTER_URL") or local_url():
        try:
            with Client.connect() as client:
                return store_of(client)
        except (ServerError, Unavailable, Unreachable):
            return None
    return str(place) if place.is_dir() else None


def store_of(client: Client) -> str | None:
    """The path of the controller's store; None where it is not on this machine, or the controller does not say."""
    try:
        place = Path(client.get("/api/capacity")["store"])
    except (ApiError, ServerError, Unavailable, Unreachable):
        return None
    return str(place) if place.is_dir() else None


def tell(spec: Spec) -> None:
    """Print a spec's warnings on standard error."""
    for note in spec.notes:
        tell_note(note)


def tell_note(note: str) -> None:
    """Print a warning on standard error."""
    echo(f"note: {one_line(note)}", err=True)


def on_engine(client: Client, spec: Spec, engine: str, source: str) -> Spec:
    """The same spec for the queue of that engine. Raises SpecError if the controller lacks it."""
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


def on_queue(changes: Sequence[str] | None, queue: str | None) -> list[str]:
    """The change that sends a job to ``queue``. Raises SpecError if ``changes`` name a queue too."""
    if queue is None:
        return []
    for change in changes or ():
        if change.partition("=")[0] == "queue":
            raise SpecError(f"--set {change}: --queue or --engine sets the queue ({queue}); give one of them")
    return [f"queue={json.dumps(queue)}"]


def called(changes: Sequence[str] | None, name: str | None) -> list[str]:
    """The change that names a job. Raises SpecError where ``changes`` do, too."""
    if name is None:
        return []
    if twice := next((each for each in changes or () if each.partition("=")[0] == "name"), None):
        raise SpecError(f"--set {twice}: --name {name} names the job; give one of them")
    return [f"name={json.dumps(name)}"]


def check_engine(name: str) -> None:
    """Raises SpecError for a name that no engine has."""
    if name not in ENGINES:
        raise SpecError(f"--engine {name}: there is no such engine; {nearest(name, ENGINES)}")


def stop(
    job: JobArgument,
    reason: Annotated[str, typer.Option(help="Reason, kept with the job.")] = "stopped by the user",
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Return only when the job has ended.")] = True,
) -> None:
    """Stop a job: it checkpoints and exits; `muster resume` continues from there.

    A training ends its iteration first. One that does not end within the 30 s that a job has is left, and `muster resume` repeats it.
    """
    with Client.connect() as client:
        detail = client.get(f"/api/jobs/{named(job)}")
        which = _titled(detail)
        if detail["status"] in TERMINAL:
            echo(f"{which} is {detail['status']} already{next_step(detail)}")
            return
        client.batch("TerminateJob", jobId=detail["id"], reason=reason)
        said, patience = detail["statusReason"], time.monotonic() + _PATIENCE
        slow = wait and slow_iteration(detail)
        while wait and detail["status"] not in TERMINAL:
            time.sleep(0.2)
            detail = client.get(f"/api/jobs/{detail['id']}")
            if detail["statusReason"] != said and time.monotonic() > patience:
                said = detail["statusReason"]
                echo(f"{which}: {one_line(said)}", err=True)
            if slow and time.monotonic() > patience:
                echo(slow, err=True)
                slow = ""
    if not wait:
        echo(f"{which} is asked to stop")
        return
    echo(f"{which} ended: {one_line(detail['statusReason'])}")
    if lost := lost_iterations(detail):
        echo(lost)
    if _can_go_on(detail):
        echo(f"continue with: muster resume {detail['run']}")


def owner_of(job: Mapping[str, Any]) -> str:
    """The owner of a job where there are several people: a key without the word, another user; empty otherwise."""
    owner: str = job["owner"] or ""
    if owner.startswith("key "):
        return owner.removeprefix("key ")
    return owner if owner.startswith(("user ", "MUSTER_TOKEN")) and not job.get("isOwn", True) else ""


def _titled(detail: Mapping[str, Any]) -> str:
    """A job's name and id, and its owner where that is another."""
    owner = "" if detail["isOwn"] else owner_of(detail)
    return reasons.named(detail["name"], detail["id"]) + (f" of {owner}" if owner else "")


def _can_go_on(detail: Mapping[str, Any]) -> bool:
    """Whether a job's run can be resumed: it comes from YAML, is no array, and has a checkpoint or runs a command."""
    if not detail["spec"] or detail["children"]:
        return False
    return bool((detail["results"] or {}).get("checkpoint") or (detail["kind"] == "command" and detail["run"]))


def next_step(detail: Mapping[str, Any]) -> str:
    """What a person can do next with a job that is over, as the end of a sentence; empty where nothing comes to mind."""
    if not _can_go_on(detail):
        return ""
    run = detail["run"]
    if detail["status"] != "SUCCEEDED":
        return f"; continue with: muster resume {run}"
    if detail["kind"] != "train":
        return ""
    more = 2 * int(detail["spec"]["train"]["iterations"])
    return f"; to train it further: muster resume {run} --set train.iterations={more} -f"


def slow_iteration(detail: Mapping[str, Any]) -> str:
    """A warning about the present iteration of a training whose iterations last long; empty for others."""
    seconds = (detail["progress"] or {}).get("iteration_seconds") or 0.0
    if detail["kind"] != "train" or detail["status"] != "RUNNING" or seconds < _PATIENCE:
        return ""
    return (
        f"an iteration takes about {seconds:.0f} s; one that does not end in the time that the job has to leave (30 s, unless the "
        f"engine gives less) is left, and resume repeats it; to lose none: muster checkpoint {detail['name']}, then stop"
    )


def lost_iterations(detail: Mapping[str, Any]) -> str:
    """The iterations of a stopped training that no checkpoint has; empty without any, and for other jobs."""
    done = (detail["progress"] or {}).get("iteration", 0)
    saved = (detail["results"] or {}).get("iteration", 0)
    if detail["kind"] != "train" or done <= saved:
        return ""
    return f"lost: {counted(done - saved, 'iteration')}, those after {saved} until {done}"


def checkpoint(job: JobArgument) -> None:
    """Make a training job save now; return when the checkpoint is durable."""
    with Client.connect() as client:
        answer = client.post(f"/api/jobs/{named(job)}/checkpoint", {}, seconds=180)["answer"]
    echo(answer)
    if not answer.startswith("checkpoint "):
        raise typer.Exit(1)


def stacks(job: JobArgument) -> None:
    """Print the Python and native stacks of every rank of a running job.

    The stacks go to the job's log too.
    """
    with Client.connect() as client:
        for node in client.get(f"/api/jobs/{named(job)}/stacks", seconds=180):
            echo(f"== node {node['node']}\n{node['stacks']}")


def print_schema(
    contract: Annotated[
        bool,
        typer.Option("--contract", help="Print the schema of a policy contract (contract.json) instead of a job's."),
    ] = False,
) -> None:
    """Print the JSON Schema of the job YAML, for editors, or of the policy contract."""
    echo_json(contract_schema() if contract else schema(), indent=2)
