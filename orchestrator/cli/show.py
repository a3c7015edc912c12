"""``muster show``: a job, its attempts and its results, for people."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import typer

from orchestrator.cli.jobs import JobArgument, JsonOption, owner_of
from orchestrator.cli.progress import best_told, shown_metrics
from orchestrator.cli.terminal import Console, echo_json, one_line
from orchestrator.client import Client, named
from orchestrator.domain.hosts import engine_of
from orchestrator.engines.installed import traits_of
from shared_store.contract.error_text import counted
from shared_store.contract.phases import phase_in
from shared_store.contract.plugins import sections
from shared_store.volume.evaluations import in_one_line
from shared_store.volume.learning_metrics import in_words
from shared_store.volume.metrics import warnings_of

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
COLOURS = {"SUCCEEDED": "green", "FAILED": "red", "RUNNING": "cyan", "STARTING": "cyan", "RUNNABLE": "yellow"}


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster show ant")(show)


def _counted(summary: dict[str, int]) -> str:
    """The children of an array by state."""
    return ", ".join(f"{count} {status}" for status, count in summary.items() if count)


def _used(attempt: dict[str, Any], saves: bool) -> str:
    """GPU time of an attempt (CPU time without GPUs), and the lost part if known, which only a job that ``saves`` has."""
    kind = "Gpu" if attempt["gpuSeconds"] else "Cpu"
    used, lost = attempt[f"{kind.lower()}Seconds"], attempt[f"wasted{kind}Seconds"]
    if not used:
        return ""
    return f", {used:.0f} {kind.upper()}-seconds" + (f", {lost:.0f} of them lost" if saves and lost >= 1 else "")


def _gpus(node: dict[str, Any]) -> str:
    """The GPUs of a node, or their number if only its engine knows them."""
    if not node["gpus"]:
        return ""
    known = node.get("devices") or (node["gpus"] if traits_of(engine_of(node["host"])).gpu_ids else None)
    if known:
        return f", GPUs {','.join(known)}"
    return f", {counted(len(node['gpus']), 'GPU')}"


def _fate(detail: dict[str, Any]) -> str:
    """What became of the job's run, if it is not there any more."""
    if detail["runIsReplaced"]:
        return " (gone; another run has its name now)"
    return " (deleted, with its logs)" if detail["runIsGone"] else ""


def show(job: JobArgument, as_json: JsonOption = False) -> None:
    """Show a job: its state and the reason, its attempts and nodes, its run and results."""
    with Client.connect() as client:
        detail = client.get(f"/api/jobs/{named(job)}")
        detail["job"] = client.batch("DescribeJobs", jobs=[detail["id"]])["jobs"][0]
    if as_json:
        echo_json(detail, indent=1)
        return
    console = Console(highlight=False, soft_wrap=True)
    colour = COLOURS.get(detail["status"], "white")
    console.print(f"[bold]{detail['name']}[/]  {detail['id']}  [{colour}]{detail['status']}[/]")
    facts = {
        "why": "" if detail["status"] == "SUCCEEDED" else one_line(detail["statusReason"] or ""),
        "in AWS's API": "" if detail["status"] == "SUCCEEDED" else one_line(detail["awsCode"] or ""),
        "phase": phase.words if (phase := phase_in(detail)) else "",
        "owner": owner_of(detail),
        "created": when(detail["createdAt"]),
        "took": took(detail["ranSeconds"]),
        "queue": detail["queue"] + (f", share {detail['share']}" if detail["share"] else ""),
        "run": detail["run"] + _fate(detail),
        "store": one_line(detail.get("storeProblem") or ""),
        _OF_RUN.get(detail["kind"], ""): _source(detail),
        "started from": started_from((detail["results"] or {}).get("parent")),
        "definition": detail["job"]["jobDefinition"].rpartition("/")[2],
        "no effect": ", ".join(detail.get("withoutEffect") or []),
    }
    results = detail["results"] or {}
    array = detail["job"].get("arrayProperties", {})
    if "statusSummary" in array:  # the children have runs and nodes, not the array
        facts["run"] = None
        first = detail["children"][0]["index"] if detail["children"] else 0  # one that failed comes first
        facts["children"] = (
            f"{array['size']}: {_counted(array['statusSummary'])}; muster show {detail['id'][:8]}:{first}"
        )
    if progress := detail["progress"]:
        total = ((detail["spec"] or {}).get("train") or {}).get("iterations", "?")
        shown = shown_metrics(progress).replace("  ", ", ")
        facts["progress"] = (
            f"iteration {progress['iteration']} of {total}, reward {_number(progress.get('reward'))}{shown}"
        )
        facts["learning"] = in_words(progress)
        facts["warning"] = f"\n{'':16}".join(map(one_line, warnings_of(progress, detail["run"])))
    if evaluation := results.get("evaluation"):
        facts["evaluation"] = in_one_line(evaluation)
    facts["best"] = best_told(detail["run"], results.get("best"))
    facts["evaluating"] = _automatic(detail["run"], results.get("automatic"))
    facts |= {name: results.get(name) for name in ("checkpoint", "plot", "picture")} | {
        "directory": results.get("path")
    }
    for name, value in facts.items():
        if value:
            console.print(f"  {name + ':':13} {value}", markup=False)
    _show_children(console, detail)
    spent = 0
    for attempt in detail["attempts"]:
        started = attempt["startedAt"] is not None
        ended = attempt["ending"] or ("running" if started else "is being started")
        counted = "" if attempt["spent"] else ", not counted"
        spent += bool(attempt["spent"])
        number = f"{attempt['number']} of {detail['attemptsAllowed']}"
        if spent < attempt["number"]:  # attempts that exited on request don't count against the allowed number
            number = f"{attempt['number']} ({spent} of {detail['attemptsAllowed']} spent)"
        reason = f": {one_line(attempt['statusReason'])}" if attempt["statusReason"] and ended != "succeeded" else ""
        lasted = took(attempt["ranSeconds"])
        console.print(
            f"  attempt {number} (epoch {attempt['epoch']}, {lasted}{_used(attempt, detail['kind'] == 'train')}) {ended}{counted}{reason}",
            markup=False,
        )
        for node in attempt["nodes"]:
            state = "running" if started else "not started yet"
            if not node["running"]:
                code = f"exit {node.get('exitCode', '?')}"
                state = f"{code}: {one_line(node.get('reason', '')).removeprefix(f'{code}, ')}"
            where = f"{node['host']}{_gpus(node)}"
            console.print(f"    node {node['index']}  {node.get('address', '-')} on {where}  {state}", markup=False)
            if node["log"] and not detail["runIsGone"]:  # not before the attempt has its run
                console.print(f"      {node['log']}", markup=False, style="dim")


def _show_children(console: Console, detail: Mapping[str, Any]) -> None:
    """A line for each of an array's children, those that failed first."""
    children = detail["children"] or []
    for child in children[:_CHILDREN]:
        reason = "" if child["status"] == "SUCCEEDED" else one_line(child["statusReason"] or "")
        lasted = took(child["ranSeconds"])
        console.print(f"    {child['index']:>5}  {child['status']:9}  {lasted:>8}  {reason}".rstrip(), markup=False)
    if detail["job"].get("arrayProperties", {}).get("size", 0) > _CHILDREN and children:
        console.print(f"    … the first {_CHILDREN}, those that failed first; --json has 100", markup=False)


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
        parts.append(
            f"{run}@{state['iteration']} by job {state['job'][:8]}, {state['status'] or 'which can not be seen'}{reason}"
        )
    if state["passed"]:
        parts.append(f"{counted(state['passed'], 'checkpoint')} passed over for newer ones")
    if state["problem"]:
        parts.append(one_line(state["problem"]))
    return "; ".join(parts)


def started_from(parent: Mapping[str, Any] | None) -> str:
    """The source of a clone's weights, in one line; empty for other runs."""
    if not parent:
        return ""
    score = scored(parent.get("score"), parent.get("score_error"))
    known = f", score {score}" if score != "-" else ""
    return f"{parent.get('run')}@{parent.get('iteration')} (checkpoint {parent.get('checkpoint')}{known})"


def scored(score: float | None, error: float | None) -> str:
    """A score with its standard error, if known: ``812.30 ± 4.10``."""
    if score is None:
        return "-"
    return f"{score:.2f}" + (f" ± {error:.2f}" if error is not None else "")


def when(milliseconds: int | None) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(milliseconds / 1000)) if milliseconds else "-"


def took(ran: float | None) -> str:
    """The ``ranSeconds`` of a job or an attempt as h:mm:ss."""
    if ran is None:
        return "-"
    seconds = int(ran)
    return f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
