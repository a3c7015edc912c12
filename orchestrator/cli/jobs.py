"""Commands for jobs: ``muster submit``, ``stop``, ``checkpoint``, ``stacks``, ``schema``."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from orchestrator.cli import command_options as options
from orchestrator.cli.progress import outcome
from orchestrator.cli.submitting import load_spec, on_engine, plan_spec, report, store_here, submit_spec
from orchestrator.cli.terminal import echo, echo_json, one_line
from orchestrator.client import Client, named
from orchestrator.domain import reasons
from orchestrator.domain.job import TERMINAL
from orchestrator.spec.json_schema import contract_schema, schema
from shared_store.contract.error_text import counted

_EXAMPLES = """Examples:  muster submit job_specs/ant.yaml --set train.iterations=600 -f
muster submit job_specs/ant.yaml --name ant-2 --set train.seed=2 --dry-run"""
_PATIENCE = 3.0
"""Seconds after which a slow stop explains itself."""
_POLL = 0.2
"""Seconds between two requests for the state of a job that stops."""


def register(app: typer.Typer) -> None:
    app.command(epilog=_EXAMPLES)(submit)
    app.command(epilog="Examples:  muster stop ant   then   muster resume RUN     muster stop ant walker")(stop)
    app.command(epilog="Example:  muster checkpoint ant")(checkpoint)
    app.command(epilog="Example:  muster stacks ant > stacks.txt")(stacks)
    app.command("schema", epilog="Example:  muster schema > muster.schema.json     or:  muster schema --contract")(
        print_schema
    )


def submit(
    spec: options.SpecArgument,
    set_: options.SetOption = None,
    name: options.NameOption = None,
    queue: options.QueueOption = None,
    engine: options.EngineOption = None,
    nodes: options.NodesOption = None,
    follow_: options.FollowOption = False,
    dry_run: options.DryRunOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Submit a job to a running controller.

    Of the machine's environment it gets what programs need, and what `muster serve --inherit NAME` names; environment: of the YAML adds
    values.
    """
    loaded = load_spec(spec, set_, name, queue, nodes, store_here)
    with Client.connect() as client:
        loaded = on_engine(client, loaded, engine, spec)
        if dry_run:
            plan_spec(client, loaded, as_json)
            return
        submitted = submit_spec(client, loaded, spec)
        report(client, submitted, f"submitted {submitted['jobName']} as {submitted['jobId']}", follow_, as_json)


def stop(
    jobs: options.JobsArgument,
    reason: Annotated[str, typer.Option(help="Reason, kept with the job.")] = "stopped by the user",
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Return only when the jobs have ended.")] = True,
    as_json: options.JsonOption = False,
) -> None:
    """Stop jobs: they checkpoint and exit; `muster resume` continues.

    A training ends its iteration first. One that does not end within the 30 s that a job has is left, and `muster resume` repeats it.
    """
    with Client.connect() as client:
        found = [client.get(f"/api/jobs/{named(job)}") for job in dict.fromkeys(jobs)]
        for detail in found:
            if detail["status"] not in TERMINAL:
                client.batch("TerminateJob", jobId=detail["id"], reason=reason)
        ended = [_ended(client, detail, wait, as_json) for detail in found]
    if as_json:
        echo_json([outcome(detail) for detail in ended], indent=1)


def _ended(client: Client, detail: dict[str, Any], wait: bool, quiet: bool) -> dict[str, Any]:
    """Wait for the end of a job that was stopped, and print what becomes of it; ``detail``: from before. Returns the newest detail."""
    title = _titled(detail)
    if detail["status"] in TERMINAL or not wait:
        has_ended = detail["status"] in TERMINAL
        if not quiet:
            echo(title + (f" is {detail['status']} already{next_step(detail)}" if has_ended else ": stop requested"))
        return detail
    known, patience, slow = detail["statusReason"], time.monotonic() + _PATIENCE, slow_iteration(detail)
    while detail["status"] not in TERMINAL:
        time.sleep(_POLL)
        detail = client.get(f"/api/jobs/{detail['id']}")
        if time.monotonic() < patience:
            continue
        if detail["statusReason"] != known:
            known = detail["statusReason"]
            echo(f"{title}: {one_line(known)}", err=True)
        if slow:
            echo(slow, err=True)
            slow = ""
    if not quiet:
        echo(f"{title} ended: {one_line(detail['statusReason'])}")
        if lost := lost_iterations(detail):
            echo(lost)
        if _can_continue(detail):
            echo(f"continue with: muster resume {detail['run']}")
    return detail


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


def _can_continue(detail: Mapping[str, Any]) -> bool:
    """Whether a job's run can be resumed: it comes from YAML, is not an array, and has a checkpoint or runs a command."""
    if not detail["spec"] or detail["children"]:
        return False
    return bool((detail["results"] or {}).get("checkpoint") or (detail["kind"] == "command" and detail["run"]))


def next_step(detail: Mapping[str, Any]) -> str:
    """What a person can do next with a job that has ended, as the end of a sentence; empty where nothing follows."""
    if not _can_continue(detail):
        return ""
    if detail["status"] != "SUCCEEDED":
        return f"; continue with: muster resume {detail['run']}"
    if detail["kind"] != "train":
        return ""
    more = 2 * int(detail["spec"]["train"]["iterations"])
    return f"; to train it further: muster resume {detail['run']} --set train.iterations={more} -f"


def slow_iteration(detail: Mapping[str, Any]) -> str:
    """A warning about the present iteration of a training whose iterations last long; empty for others."""
    seconds = (detail["progress"] or {}).get("iteration_seconds") or 0.0
    if detail["kind"] != "train" or detail["status"] != "RUNNING" or seconds < _PATIENCE:
        return ""
    return (
        f"an iteration takes about {seconds:.0f} s; one that does not end in the time that the job has to exit (30 s, unless the "
        f"engine gives less) is lost, and resume repeats it; to lose none: muster checkpoint {detail['name']}, then stop"
    )


def lost_iterations(detail: Mapping[str, Any]) -> str:
    """The iterations of a stopped training that no checkpoint has; empty without any, and for other jobs."""
    done = (detail["progress"] or {}).get("iteration", 0)
    saved = (detail["results"] or {}).get("iteration", 0)
    if detail["kind"] != "train" or done <= saved:
        return ""
    return f"lost: {counted(done - saved, 'iteration')}, those after {saved} until {done}"


def checkpoint(job: options.JobArgument, as_json: options.JsonOption = False) -> None:
    """Make a training job save now; return when the checkpoint is durable."""
    with Client.connect() as client:
        response = client.post(f"/api/jobs/{named(job)}/checkpoint", {}, seconds=180)
    if as_json:
        echo_json(response)
    else:
        echo(response["answer"])
    if not response["answer"].startswith("checkpoint "):
        raise typer.Exit(1)


def stacks(job: options.JobArgument, as_json: options.JsonOption = False) -> None:
    """Print the Python and native stacks of every rank of a running job.

    The stacks go to the job's log too.
    """
    with Client.connect() as client:
        found = client.get(f"/api/jobs/{named(job)}/stacks", seconds=180)
    if as_json:
        echo_json(found, indent=1)
        return
    for node in found:
        echo(f"== node {node['node']}\n{node['stacks']}")


def print_schema(
    contract: Annotated[
        bool,
        typer.Option("--contract", help="Print the schema of a policy contract (contract.json) instead of a job's."),
    ] = False,
) -> None:
    """Print the JSON Schema of the job YAML, or of the policy contract."""
    echo_json(contract_schema() if contract else schema(), indent=2)
