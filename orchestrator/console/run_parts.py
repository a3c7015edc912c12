"""The parts that the pages of a job and of a run have, made of the API's JSON: facts, attempts, checkpoints and evaluations."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

from orchestrator.console.formats import age, count, duration, link, moment, nodes, ran, with_error
from orchestrator.console.live import Table
from orchestrator.domain.job import Status
from orchestrator.persistence.ownership import born_at
from orchestrator.services import runs
from shared_store.contract.error_text import counted
from shared_store.contract.phases import shown_phase
from shared_store.volume.checkpoints import Checkpoint, best_checkpoint, list_checkpoints
from shared_store.volume.evaluations import by_checkpoint, changes_in_lines
from shared_store.volume.layout import Run
from shared_store.volume.learning_metrics import in_words
from shared_store.volume.metrics import finite, warnings_of

CHECKPOINTS = 30
"""Number of a run's newest checkpoints that the page of a job lists, beside the best one."""
_DAMAGED = {**dict.fromkeys(("reward", "score", "scoreError", "worlds", "size", "created")), "problem": ""}
"""Facts of a checkpoint that can't be read."""
Facts = list[tuple[str, Any]]
"""Labels and values; an empty value is left out."""


def headline_of(job: Mapping[str, Any]) -> dict[str, Any]:
    """The state of a job, the reason, and how far it is."""
    reason, problem = job["statusReason"] or "", job["storeProblem"] or ""
    if job["status"] == Status.SUCCEEDED:
        reason = ""
    training = (job["spec"] or {}).get("train") or {}
    return {
        "status": job["status"],
        "reason": reason if problem in reason else "; ".join(filter(None, (reason, problem))),
        "iteration": int(finite((job["progress"] or {}).get("iteration")) or 0),
        "iterations": training.get("iterations"),
        "saves": bool(training) and job["status"] == Status.RUNNING,
        "isOver": Status(job["status"]).is_terminal,
    }


def facts_of_job(job: Mapping[str, Any], definition: str) -> Facts:
    """The facts about a job, from the response of ``GET /api/jobs/{reference}`` and the name of its definition."""
    head, attempts, last, results = headline_of(job), job["attempts"], job["progress"] or {}, job["results"] or {}
    left = (head["iterations"] or 0) - head["iteration"]
    seconds, runs_on = finite(last.get("iteration_seconds")), not head["isOver"]
    evaluation, automatic = results.get("evaluation"), results.get("automatic")
    parent = results.get("parent") or {}
    gone = " (deleted; another run has its name now)" if job["runIsReplaced"] else " (deleted, with its logs)"
    run = link(f"/runs/{job['run']}", job["run"]) if job["results"] is not None else job["run"]
    return [
        ("Attempt", _attempt_of(job)),
        ("Where", nodes(attempts[-1]["nodes"]) if attempts and runs_on else ""),
        ("Running for" if job["runsSince"] else "Ran", ran(job)),
        ("Phase", shown_phase(job)),
        ("Time left", duration(left * seconds) if runs_on and head["iteration"] and left > 0 and seconds else ""),
        ("Since the last iteration", age(last.get("time"), 1000) if runs_on else ""),
        ("Reward", count(last.get("reward"))),
        ("Score", with_error(last.get("score"), last.get("score_error"))),
        ("Steps/s", count(last.get("steps_per_second")) if runs_on else ""),
        *learning_facts(last, job["run"]),
        ("Slowest", _straggler(last)),
        ("Saved", counted(results["checkpoints"], "checkpoint") if results.get("checkpoints") else ""),
        ("Evaluated", _evaluated(evaluation) if evaluation else ""),
        ("Evaluating", _automatic(automatic) if automatic else ""),
        ("Queue", f"{job['queue']}, share {job['share']}" if job["share"] else job["queue"]),
        ("Owner", job["owner"]),
        ("Created", moment(job["createdAt"])),
        ("Run", run + gone if job["runIsReplaced"] or job["runIsGone"] else run),
        ("Started from", f"{parent['run']}@{parent.get('iteration')}" if parent.get("run") else ""),
        ("Definition", definition),
    ]


def learning_facts(metrics: Mapping[str, Any], run: str) -> Facts:
    """How a training learns, by its newest record."""
    return [("Learning", in_words(metrics)), ("Warning", "; ".join(warnings_of(metrics, run)))]


def _attempt_of(job: Mapping[str, Any]) -> str:
    attempts, allowed = job["attempts"], job["attemptsAllowed"]
    if not attempts:
        return f"none yet, {allowed} allowed"
    number, charged = attempts[-1]["number"], sum(bool(each["spent"]) for each in attempts)
    return f"{number} of {allowed}" if charged == number else f"{number} ({charged} of {allowed} counted)"


def _straggler(last: Mapping[str, Any]) -> str:
    rank, excess = last.get("slowest_rank"), finite(last.get("slowest_excess"))
    return f"rank {rank}, {100 * excess:.0f} % over the median" if isinstance(rank, int) and excess is not None else ""


def _evaluated(evaluation: Mapping[str, Any]) -> str:
    text = f"return {count(evaluation.get('mean_return'))} at iteration {evaluation.get('iteration')}"
    return f"{text}, {counted(evaluation['episodes'], 'episode')}" if evaluation.get("episodes") else text


def _automatic(evaluation: Mapping[str, Any]) -> str:
    job = f"iteration {evaluation['iteration']}, {evaluation['status'] or 'status unknown (no permission)'}"
    return "; ".join(filter(None, (job if evaluation["job"] else "", evaluation["problem"])))


def attempts_of(job: Mapping[str, Any]) -> Table:
    """The attempts of a job by their numbers, each with its part of the job's life so far: ``from`` and ``span`` [%]."""
    begin = job["createdAt"]
    end = max(job["stoppedAt"] or int(time.time() * 1000), begin + 1)
    rows = Table()
    for each in job["attempts"]:
        first = each["startedAt"] or each["stoppedAt"] or end
        start, span = (100 * each / (end - begin) for each in (first - begin, (each["stoppedAt"] or end) - first))
        part = {"from": f"{max(0.0, start):.1f}", "span": f"{max(0.4, span):.1f}"}
        rows[str(each["number"])] = {**each, **part, "saves": job["kind"] == "train"}
    return rows


def checkpoints_of(run: Run, most: int | None = None) -> Table:
    """A run's checkpoints by their names, the newest first; ``most``: that many of the newest, and the best one. Raises OSError."""
    found = list_checkpoints(run)
    evaluated, best, born = by_checkpoint(run), best_checkpoint(run), born_at(run)
    shown = found[-most:] if most else found
    if best is not None and best not in shown:
        shown = [best, *shown]
    rows = Table()
    for each in reversed(shown):
        marks = {"newest": each == found[-1], "best": each == best, "exported": (run.exports / each.name).is_dir()}
        rows[each.name] = {
            **_DAMAGED,
            **_described(each, born),
            "evaluated": _result(evaluated.get(each.name, {})),
            "marks": ", ".join(name for name, is_so in marks.items() if is_so),
        }
    return rows


@lru_cache(maxsize=4096)
def _described(checkpoint: Checkpoint, born: int) -> dict[str, Any]:
    """The facts that a checkpoint holds; they never change in a run that was created at ``born`` [Unix ms]."""
    return runs.describe_checkpoint(checkpoint, verify=False)


def evaluations_of(summaries: Iterable[Mapping[str, Any]], run: str) -> Table:
    """Evaluations of a run by their names."""
    rows = Table()
    for each in summaries:
        success = each.get("success")
        share = finite(success.get("share")) if isinstance(success, Mapping) else None
        rows[str(each.get("name"))] = {
            **{name: each.get(name) for name in ("name", "checkpoint", "seed", "episodes", "time")},
            "run": run,
            "result": _result(each),
            "success": "" if share is None else f"{100 * share:.1f} %",
            "length": f"{each['mean_length']:.1f} of {each['max_length']}",
            "changes": ", ".join(f"{place}: {value}" for place, value in changes_in_lines(each)),
        }
    return rows


def _result(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The mean return of an evaluation, and the high end of its 95 % interval."""
    result = summary.get("return")
    return {"mean": summary.get("mean_return"), "high": result.get("high") if isinstance(result, Mapping) else None}
