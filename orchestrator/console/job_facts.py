"""The facts on the page of a job, as texts: its state and the reason, its progress, the time line of its attempts, its checkpoints."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from orchestrator.console import formats as words
from orchestrator.control.controller import Controller
from orchestrator.domain.errors import ClientError
from orchestrator.domain.job import Status
from orchestrator.persistence.ownership import born_at
from orchestrator.services import runs
from orchestrator.services.context import permitted_run
from orchestrator.services.permissions import Actor, Operation
from shared_store.contract.error_text import counted
from shared_store.contract.phases import Phase
from shared_store.volume.checkpoints import Checkpoint, best_checkpoint, list_checkpoints
from shared_store.volume.evaluations import by_checkpoint
from shared_store.volume.layout import Run
from shared_store.volume.learning_metrics import in_words
from shared_store.volume.metrics import finite, warnings_of

CHECKPOINTS = 30
"""Number of a run's newest checkpoints that are listed, beside the best one."""
_NODES = 16
"""Number of an attempt's nodes that are named."""


def facts_of(detail: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of the page that change, from the answer of ``GET /api/jobs/{reference}``."""
    status = detail["status"]
    is_over = Status(status).is_terminal
    training = (detail["spec"] or {}).get("train") or {}
    last = detail["progress"] or {}
    iteration, iterations = int(finite(last.get("iteration")) or 0), training.get("iterations") or 0
    seconds = finite(last.get("iteration_seconds"))
    attempts = detail["attempts"]
    results = detail["results"] or {}
    reason = (detail["statusReason"] or "") if status != Status.SUCCEEDED else ""
    problem = detail["storeProblem"] or ""
    return {
        "status": status,
        "reason": reason if problem in reason else "; ".join(each for each in (reason, problem) if each),
        "open": "" if is_over else "yes",
        "run": "yes" if detail["results"] is not None else "",
        "saves": "yes" if status == Status.RUNNING and training else "",
        "done": iteration,
        "iterations": iterations or 1,
        "progress": f"{iteration} of {iterations}" if iterations and iteration else "",
        "left": words.duration((iterations - iteration) * seconds)
        if not is_over and 0 < iteration < iterations and seconds is not None
        else "",
        "rate": words.count(last.get("steps_per_second")) if not is_over else "",
        "reward": words.count(last.get("reward")),
        "score": _with_error(last.get("score"), last.get("score_error")),
        "straggler": _straggler(last),
        "learning": in_words(last),
        "warning": "; ".join(warnings_of(last, detail["run"])),
        "reported": words.moment(last["time"] * 1000)
        if not is_over and isinstance(last.get("time"), int | float)
        else "",
        "phase": Phase(detail["phase"]).words if detail["phase"] else "",
        "attempt": _attempt_of(detail),
        "where": _where(attempts[-1]["nodes"]) if attempts and not is_over else "",
        "since": words.moment(detail["runsSince"]),
        "took": "" if detail["runsSince"] else words.duration(detail["ranSeconds"]),
        "saved": counted(results["checkpoints"], "checkpoint") if results.get("checkpoints") else "",
        "evaluated": _evaluated(results.get("evaluation")),
        "evaluating": _automatic(results.get("automatic")),
    }


def child_of(child: Mapping[str, Any]) -> dict[str, Any]:
    """The row of an array's child."""
    return {
        **{name: child[name] for name in ("index", "id", "status")},
        "reason": (child["statusReason"] or "") if child["status"] != Status.SUCCEEDED else "",
        "since": words.moment(child["runsSince"]),
        "took": "" if child["runsSince"] else words.duration(child["ranSeconds"]),
    }


def attempts_of(detail: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The rows of the attempts, by number; ``from`` and ``span`` are percents of the job's life so far."""
    begin = detail["createdAt"]
    end = max(detail["stoppedAt"] or int(time.time() * 1000), begin + 1)
    saves = detail["kind"] == "train"
    return {str(each["number"]): _attempt(each, begin, end, saves) for each in detail["attempts"]}


def _attempt(attempt: Mapping[str, Any], begin: int, end: int, saves: bool) -> dict[str, Any]:
    started, stopped = attempt["startedAt"], attempt["stoppedAt"]
    first = started or stopped or end
    ended = attempt["ending"] or ("running" if started else "starting")
    kind = "gpu" if attempt["gpuSeconds"] else "cpu"
    used, lost = attempt[f"{kind}Seconds"], attempt[f"wasted{kind.title()}Seconds"]
    cost = f"{words.duration(used)} of {kind.upper()}s" if used else ""
    lost_words = f", {words.duration(lost)} lost" if used and saves and lost >= 1 else ""
    return {
        "number": str(attempt["number"]),
        "epoch": str(attempt["epoch"]),
        "ending": f"{ended}{'' if attempt['spent'] else ', not counted'}",
        "kind": ended,
        "why": (attempt["statusReason"] or "") if ended != "succeeded" else "",
        "started": words.moment(started),
        "took": words.duration(attempt["ranSeconds"]) if stopped else "",
        "since": words.moment(attempt["runsSince"]),
        "cost": cost + lost_words,
        "from": f"{max(0.0, 100 * (first - begin) / (end - begin)):.1f}",
        "span": f"{max(0.4, 100 * ((stopped or end) - first) / (end - begin)):.1f}",
        "nodes": _where(attempt["nodes"]),
    }


def _where(nodes: Sequence[Mapping[str, Any]]) -> str:
    """The host of each node, and its end."""
    told = []
    for node in nodes[:_NODES]:
        gpus = f", {counted(len(node['gpus']), 'GPU')}" if node["gpus"] else ""
        ended = ""
        if not node["running"]:
            code = node.get("exitCode")
            reason = (node.get("reason") or "").removeprefix(f"exit {code}, ")
            ended = f" (exit {'?' if code is None else code}{f': {reason}' if reason else ''})"
        told.append(f"node {node['index']} on {node['host']}{gpus}{ended}")
    if len(nodes) > _NODES:
        told.append(f"and {counted(len(nodes) - _NODES, 'more node')}")
    return "; ".join(told)


def _attempt_of(detail: Mapping[str, Any]) -> str:
    attempts = detail["attempts"]
    if not attempts:
        return f"none yet, {detail['attemptsAllowed']} allowed"
    number, spent = attempts[-1]["number"], sum(bool(each["spent"]) for each in attempts)
    allowed = detail["attemptsAllowed"]
    return f"{number} of {allowed}" if spent == number else f"{number} ({spent} of {allowed} spent)"


def _straggler(last: Mapping[str, Any]) -> str:
    rank, excess = last.get("slowest_rank"), finite(last.get("slowest_excess"))
    if not isinstance(rank, int) or excess is None:
        return ""
    return f"rank {rank}, {100 * excess:.0f} % over the median"


def _with_error(value: Any, error: Any) -> str:
    if finite(value) is None:
        return ""
    return words.count(value) + (f" ± {words.count(error)}" if finite(error) is not None else "")


def _evaluated(evaluation: Mapping[str, Any] | None) -> str:
    if not evaluation or not isinstance(evaluation.get("mean_return"), int | float):
        return ""
    told = f"return {words.count(evaluation['mean_return'])} at iteration {evaluation.get('iteration')}"
    return f"{told}, {counted(evaluation['episodes'], 'episode')}" if evaluation.get("episodes") else told


def _automatic(told: Mapping[str, Any] | None) -> str:
    if not told:
        return ""
    parts = [f"iteration {told['iteration']}, {told['status'] or 'out of sight'}"] if told["job"] else []
    return "; ".join([*parts, *([told["problem"]] if told["problem"] else [])])


def checkpoints_of(controller: Controller, actor: Actor, run: str) -> dict[str, dict[str, Any]]:
    """The rows of a run's newest checkpoints and its best one, by name, the newest first; none where they can't be seen."""
    try:
        found = permitted_run(controller, actor, run, Operation.READ_CHECKPOINTS)
        return _checkpoints(found)
    except (ClientError, OSError):
        return {}


def _checkpoints(run: Run) -> dict[str, dict[str, Any]]:
    there = list_checkpoints(run)
    if not there:
        return {}
    evaluated, best = by_checkpoint(run), best_checkpoint(run)
    shown = there[-CHECKPOINTS:]
    if best is not None and best.name not in {each.name for each in shown}:
        shown = [best, *shown]
    exported = {each.name for each in shown if (run.exports / each.name).is_dir()}
    rows, born = {}, born_at(run)
    for each in reversed(shown):
        marks = {
            "newest": each is there[-1],
            "best": best and each.name == best.name,
            "exported": each.name in exported,
        }
        rows[each.name] = _checkpoint(
            each, born, evaluated.get(each.name), [name for name, is_so in marks.items() if is_so]
        )
    return rows


def _checkpoint(
    checkpoint: Checkpoint, born: int, evaluated: Mapping[str, Any] | None, marks: Sequence[str]
) -> dict[str, Any]:
    facts = _described(checkpoint, born)
    return {
        "iteration": str(checkpoint.iteration),
        "epoch": str(checkpoint.epoch),
        "label": f"Checkpoint of iteration {checkpoint.iteration}, epoch {checkpoint.epoch}",
        "reward": words.count(facts.get("reward")),
        "score": _with_error(facts.get("score"), facts.get("scoreError")),
        "evaluated": words.count(evaluated["mean_return"]) if evaluated else "",
        "size": f"{facts['size'] / 2**20:.1f} MiB" if facts.get("size") else "",
        "created": words.moment(facts["created"] * 1000) if facts.get("created") else "",
        "marks": ", ".join(marks),
        "problem": facts.get("problem") or "",
    }


@lru_cache(maxsize=4096)
def _described(checkpoint: Checkpoint, born: int) -> dict[str, Any]:
    """The facts that a checkpoint holds; they never change in a run that was created at ``born`` [Unix ms]."""
    return runs.describe_checkpoint(checkpoint, verify=False)
