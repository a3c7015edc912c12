"""``muster list`` and ``muster show``: jobs, and one job with its attempts and its results, for people."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Annotated, Any

import typer
from rich.text import Text

from orchestrator.cli.command_options import (
    JobArgument,
    JsonOption,
    NamesOption,
    SinceOption,
    literal_part,
    seconds_since,
)
from orchestrator.cli.jobs import owner_of
from orchestrator.cli.listings import Resource, date_ms, duration, number, scored, show_facts
from orchestrator.cli.progress import describe_best, shown_metrics
from orchestrator.cli.terminal import Console, echo, echo_json, one_line
from orchestrator.client import Client, named
from orchestrator.domain.errors import UsageError
from orchestrator.domain.hosts import engine_of
from orchestrator.domain.job import Status
from orchestrator.engines.installed import traits_of
from shared_store.contract.error_text import counted, nearest
from shared_store.contract.phases import shown_phase
from shared_store.contract.plugins import sections
from shared_store.volume.evaluations import in_one_line
from shared_store.volume.learning_metrics import in_words
from shared_store.volume.metrics import warnings_of

_NEWEST = 20
_A_PAGE = 100
"""Greatest number of jobs in a response."""
_AUTOMATIC = "automaticEvaluation"
"""Key of a job for the subject of an automatic evaluation, ``RUN@ITERATION``."""
_OF_RUN = {
    "evaluate": "evaluates",
    "export": "exports",
    "record": "records",
    "render": "renders",
    **{key: section.verb for key, section in sections().items()},
}
"""Verb for what a job of each kind does with another run."""
_CHILDREN = 20
"""Greatest number of an array's children that are printed."""
_COLOURS = {"SUCCEEDED": "green", "FAILED": "red", "RUNNING": "cyan", "STARTING": "cyan", "RUNNABLE": "yellow"}


def _reason(job: Mapping[str, Any]) -> str:
    """Why a job is in its state; empty for one that SUCCEEDED."""
    return "" if job["status"] == "SUCCEEDED" else one_line(job["statusReason"] or "")


def _coloured(job: Mapping[str, Any]) -> Text:
    return Text(job["status"], _COLOURS.get(job["status"], "white"))


JOBS = Resource(
    {
        "JOB": lambda job: job["id"][:8],
        "NAME": "name",
        "OWNER": owner_of,
        "STATUS": _coloured,
        "NODES": lambda job: f"1 × {job['arraySize']}" if job["arraySize"] else job["nodes"],
        "CREATED": lambda job: date_ms(job["createdAt"]),
        "TOOK": lambda job: duration(job["ranSeconds"]),
        "RUN": lambda job: "" if job["arraySize"] else job["run"],  # an array's children have runs
        "REASON": lambda job: "; ".join(
            filter(None, (f"evaluates {job[_AUTOMATIC]}" if job[_AUTOMATIC] else "", _reason(job)))
        ),
    },
    "no jobs yet; start one with: muster submit job_specs/cartpole.yaml",
    optional=("OWNER",),
)


def register(app: typer.Typer) -> None:
    app.command(
        "list",
        epilog="Examples:  muster list --status RUNNING --mine     muster list --name 'ant-*' --since 2d     "
        "muster list --json | jq '.[].jobId'",
    )(list_jobs)
    app.command(epilog="Example:  muster show ant")(show)


def list_jobs(
    all_: Annotated[
        bool, typer.Option("--all", "-a", help="List all jobs, not just the newest 20 without automatic evaluations.")
    ] = False,
    status: Annotated[
        list[str] | None,
        typer.Option(metavar="STATUS", help="Only jobs with this status, such as RUNNING. Repeatable."),
    ] = None,
    name: NamesOption = None,
    run: Annotated[str | None, typer.Option(metavar="RUN", help="Only jobs of this run.")] = None,
    queue: Annotated[str | None, typer.Option("--queue", metavar="QUEUE", help="Only jobs of this queue.")] = None,
    since: SinceOption = None,
    mine: Annotated[bool, typer.Option("--mine", help="Only jobs that you submitted.")] = False,
    as_json: JsonOption = False,
) -> None:
    """List jobs, the newest first.

    Evaluations that a controller submits beside a training are only counted; --all and --json list them.
    """
    age = seconds_since(since)
    oldest = 0 if age is None else (time.time() - age) * 1000

    def fits(job: Mapping[str, Any]) -> bool:
        has_name = name is None or fnmatchcase(job["name"], name)
        return has_name and run in (None, job["run"]) and (job.get("isOwn", True) or not mine)

    statuses = [each.upper() for each in status or ()]
    if wrong := [each for each in statuses if each not in set(Status)]:
        raise UsageError(f"--status {wrong[0]}: unknown status; {nearest(wrong[0], Status)}")
    query = {"status": statuses or None, "queue": queue, "search": run or literal_part(name) or None}
    with Client.connect() as client:
        jobs = _newest(client, query, fits, oldest, None if all_ else _NEWEST, automatic=as_json)
        if (
            run
            and not jobs
            and not _newest(client, {"search": run}, lambda job: job["run"] == run, 0, 1, automatic=True)
        ):
            client.get(f"/api/runs/{named(run)}")  # refuses an unknown one
    if as_json:
        echo_json(jobs if all_ else jobs[:_NEWEST], indent=1)
        return
    shown = jobs if all_ else [each for each in jobs if not each[_AUTOMATIC]][:_NEWEST]
    is_filtered = any((status, name, run, queue, since, mine))
    empty = replace(JOBS, empty="no job fits; without these options `muster list` lists all") if is_filtered else JOBS
    if shown or not jobs:
        empty.show(shown)
    last = shown[-1]["createdAt"] if len(shown) == _NEWEST else 0
    if hidden := 0 if all_ else sum(bool(each[_AUTOMATIC]) and each["createdAt"] >= last for each in jobs):
        what = counted(hidden, "automatic evaluation")
        echo(f"{what} {'is' if hidden == 1 else 'are'} not shown; --all shows {'it' if hidden == 1 else 'them'}")


def _newest(
    client: Client,
    query: Mapping[str, Any],
    fits: Callable[[Mapping[str, Any]], bool],
    oldest: float,
    least: int | None,
    automatic: bool,
) -> list[dict[str, Any]]:
    """The newest jobs that fit and are not older than ``oldest`` [Unix ms], at least so many, or all. Unless ``automatic``, automatic evaluations do not count."""
    found: list[dict[str, Any]] = []
    after: str | None = ""
    while after is not None:
        page = client.get("/api/jobs", after=after, max=_A_PAGE, progress=False, **query)
        # the ids and names as the AWS Batch API has them, too: scripts use both
        found += [
            {"jobId": each["id"], "jobName": each["name"], **each}
            for each in page["jobs"]
            if each["createdAt"] >= oldest and fits(each)
        ]
        after = page["next"]
        if least is not None and sum(automatic or not each[_AUTOMATIC] for each in found) >= least:
            break
        if page["jobs"] and page["jobs"][-1]["createdAt"] < oldest:
            break
    return found


def show(job: JobArgument, as_json: JsonOption = False) -> None:
    """Show a job: why it is in its state, its attempts and nodes, its results."""
    with Client.connect() as client:
        detail = client.get(f"/api/jobs/{named(job)}")
        detail["job"] = client.batch("DescribeJobs", jobs=[detail["id"]])["jobs"][0]
    if as_json:
        echo_json(detail, indent=1)
        return
    console = Console(highlight=False, soft_wrap=True)
    console.print(Text.assemble((detail["name"], "bold"), f"  {detail['id']}  ", _coloured(detail)))
    show_facts(_facts(detail))
    _show_children(detail)
    for attempt in detail["attempts"]:
        _show_attempt(console, detail, attempt)


def _facts(detail: Mapping[str, Any]) -> dict[str, object]:
    """What is known about a job, by the words of `muster show`."""
    results, is_array = detail["results"] or {}, "statusSummary" in detail["job"].get("arrayProperties", {})
    facts: dict[str, object] = {
        "why": _reason(detail),
        "in AWS's API": "" if detail["status"] == "SUCCEEDED" else one_line(detail["awsCode"] or ""),
        "phase": shown_phase(detail),
        "owner": owner_of(detail),
        "created": date_ms(detail["createdAt"]),
        "took": duration(detail["ranSeconds"]) or "-",
        "queue": detail["queue"] + (f", share {detail['share']}" if detail["share"] else ""),
        "run": "" if is_array else detail["run"] + _fate(detail),  # the children have runs and nodes, not the array
        "store": one_line(detail.get("storeProblem") or ""),
        _OF_RUN.get(detail["kind"], "-"): _source(detail),
        "started from": _started_from(results.get("parent")),
        "definition": detail["job"]["jobDefinition"].rpartition("/")[2],
        "no effect": ", ".join(detail.get("withoutEffect") or []),
    }
    if is_array:
        array = detail["job"]["arrayProperties"]
        states = ", ".join(f"{count} {status}" for status, count in array["statusSummary"].items() if count)
        first = detail["children"][0]["index"] if detail["children"] else 0  # one that failed comes first
        facts["children"] = f"{array['size']}: {states}; muster show {detail['id'][:8]}:{first}"
    if progress := detail["progress"]:
        total = ((detail["spec"] or {}).get("train") or {}).get("iterations", "?")
        more = shown_metrics(progress).replace("  ", ", ")
        reward = number(progress.get("reward")) or "-"
        facts["progress"] = f"iteration {progress['iteration']} of {total}, reward {reward}{more}"
        facts["learning"] = in_words(progress)
        facts["warning"] = f"\n{'':16}".join(map(one_line, warnings_of(progress, detail["run"])))
    if evaluation := results.get("evaluation"):
        facts["evaluation"] = in_one_line(evaluation)
    facts["best"] = describe_best(detail["run"], results.get("best"))
    facts["evaluating"] = _automatic(detail["run"], results.get("automatic"))
    facts |= {name: results.get(name) for name in ("checkpoint", "plot", "picture")}
    return facts | {"directory": results.get("path")}


def _show_attempt(console: Console, detail: Mapping[str, Any], attempt: Mapping[str, Any]) -> None:
    """A line for an attempt, and one or two for each of its nodes."""
    started = attempt["startedAt"] is not None
    ended = attempt["ending"] or ("running" if started else "is being started")
    number, allowed = attempt["number"], detail["attemptsAllowed"]
    spent = sum(bool(each["spent"]) for each in detail["attempts"][:number])
    # attempts that exited on request don't count against the allowed number
    place = f"{number} of {allowed}" if spent == number else f"{number} ({spent} of {allowed} counted)"
    reason = f": {one_line(attempt['statusReason'])}" if attempt["statusReason"] and ended != "succeeded" else ""
    lasted = (duration(attempt["ranSeconds"]) or "-") + _used(attempt, detail["kind"] == "train")
    not_counted = "" if attempt["spent"] else ", not counted"
    echo(f"  attempt {place} (epoch {attempt['epoch']}, {lasted}) {ended}{not_counted}{reason}")
    for node in attempt["nodes"]:
        state = "running" if started else "not started yet"
        if not node["running"]:
            code = f"exit {node.get('exitCode', '?')}"
            state = f"{code}: {one_line(node.get('reason', '')).removeprefix(f'{code}, ')}"
        echo(f"    node {node['index']}  {node.get('address', '-')} on {node['host']}{_gpus(node)}  {state}")
        if node["log"] and not detail["runIsGone"]:  # not before the attempt has its run
            console.print(f"      {node['log']}", markup=False, style="dim")


def _used(attempt: Mapping[str, Any], saves: bool) -> str:
    """GPU time of an attempt (CPU time without GPUs), and the lost part if known, which only a job that ``saves`` has."""
    kind = "Gpu" if attempt["gpuSeconds"] else "Cpu"
    used, lost = attempt[f"{kind.lower()}Seconds"], attempt[f"wasted{kind}Seconds"]
    if not used:
        return ""
    return f", {used:.0f} {kind.upper()}-seconds" + (f", {lost:.0f} of them lost" if saves and lost >= 1 else "")


def _gpus(node: Mapping[str, Any]) -> str:
    """The GPUs of a node, or their number if only its engine knows them."""
    if not node["gpus"]:
        return ""
    known = node.get("devices") or (node["gpus"] if traits_of(engine_of(node["host"])).gpu_ids else None)
    return f", GPUs {','.join(known)}" if known else f", {counted(len(node['gpus']), 'GPU')}"


def _fate(detail: Mapping[str, Any]) -> str:
    """What became of the job's run, if it is gone."""
    if detail["runIsReplaced"]:
        return " (gone; another run has its name now)"
    return " (deleted, with its logs)" if detail["runIsGone"] else ""


def _show_children(detail: Mapping[str, Any]) -> None:
    """A line for each of an array's children, those that failed first."""
    children = detail["children"] or []
    for child in children[:_CHILDREN]:
        lasted = duration(child["ranSeconds"]) or "-"
        echo(f"    {child['index']:>5}  {child['status']:9}  {lasted:>8}  {_reason(child)}".rstrip())
    if detail["job"].get("arrayProperties", {}).get("size", 0) > _CHILDREN and children:
        echo(f"    … the first {_CHILDREN}, those that failed first; --json has 100")


def _source(detail: Mapping[str, Any]) -> str:
    """The checkpoint of another run that a job reads, as ``RUN@ITERATION``."""
    section = (detail["spec"] or {}).get(detail["kind"])
    if not isinstance(section, dict) or "run" not in section:
        return ""
    return f"{section['run']}@{section.get('checkpoint', 'latest')}"


def _automatic(run: str, state: Mapping[str, Any] | None) -> str:
    """The newest automatic evaluation of a training in one line."""
    if not state:
        return ""
    parts = []
    if state["job"]:
        reason = f": {one_line(state['statusReason'] or '')}" if state["status"] not in ("SUCCEEDED", None) else ""
        status = state["status"] or "status unknown (no permission)"
        parts.append(f"{run}@{state['iteration']} by job {state['job'][:8]}, {status}{reason}")
    if state["passed"]:
        parts.append(f"{counted(state['passed'], 'checkpoint')} skipped for newer ones")
    if state["problem"]:
        parts.append(one_line(state["problem"]))
    return "; ".join(parts)


def _started_from(parent: Mapping[str, Any] | None) -> str:
    """The source of a clone's weights, in one line; empty for other runs."""
    if not parent:
        return ""
    score = scored(parent.get("score"), parent.get("score_error"))
    known = f", score {score}" if score else ""
    return f"{parent.get('run')}@{parent.get('iteration')} (checkpoint {parent.get('checkpoint')}{known})"
