"""The evaluations of a run: ``evaluations/<checkpoint>[-<job>].json`` is a summary, the ``.parquet`` beside it has a row per episode.

The table is written first: an evaluation exists once its summary does.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator, Mapping
from typing import Any

from shared_store.contract.error_text import counted
from shared_store.contract.plugins import rules_of, sections
from shared_store.volume.files import DamagedFile, read_json, refuse_links, write_atomic
from shared_store.volume.layout import LARGEST_DESCRIPTION, Run
from shared_store.volume.metrics import finite

TERMS_SHOWN = 6
"""Number of reward terms in a printed table: the largest ones."""

BY_CLOCK = "the clock ended the episode"
"""The criterion of success for a task that declares none: the episode's length tells as much."""

_NAME = re.compile(r"([0-9]{8}-e[0-9]{1,18})(-[A-Za-z0-9-]{1,40})?")
_NUMBERS = ("mean_return", "mean_length", "max_length", "episodes", "time")


def evaluation_name(checkpoint: str, job: str = "") -> str:
    """Name of an evaluation: its checkpoint, and for a job that only evaluates, the job, with the index of an array's child."""
    parent, _, index = job.partition(":")
    return "-".join(filter(None, (checkpoint, parent[:8], index)))


def checkpoint_of(name: str) -> str | None:
    """Name of the checkpoint of the evaluation ``name``; None for an invalid name."""
    return match[1] if (match := _NAME.fullmatch(name)) else None


def list_evaluations(run: Run) -> list[dict[str, Any]]:
    """The summaries of a run's evaluations, the newest last; damaged ones are skipped. Raises OSError."""
    found = [
        {**summary, "name": name, "checkpoint": checkpoint} for name, checkpoint, summary in _summaries(run) if summary
    ]
    return sorted(found, key=lambda summary: (summary["time"], summary["name"]))


def _summaries(run: Run) -> Iterator[tuple[str, str, dict[str, Any] | None]]:
    """Name, checkpoint and summary of each evaluation; None for a damaged one."""
    for name in [path.stem for path in run.evaluations.glob("*.json")]:
        if checkpoint := checkpoint_of(name):
            try:
                summary = read_json(run.evaluations / f"{name}.json", LARGEST_DESCRIPTION)
            except DamagedFile:
                summary = None
            numbers = [summary.get(key) for key in _NUMBERS] if summary else [None]
            yield name, checkpoint, summary if all(finite(number) is not None for number in numbers) else None


def by_checkpoint(run: Run) -> dict[str, dict[str, Any]]:
    """For each checkpoint, its evaluation in the worlds of its own training with the most episodes, of equals the newer."""
    found: dict[str, dict[str, Any]] = {}
    for summary in list_evaluations(run):
        before = found.get(summary["checkpoint"])
        if not summary.get("config") and (before is None or before["episodes"] <= summary["episodes"]):
            found[summary["checkpoint"]] = summary
    return found


def keep_for_evaluation(run: Run, checkpoint: str) -> None:
    """Protect the checkpoint of a pending evaluation from retention, in place of an earlier one. Raises as :func:`release_from_evaluation`."""
    refuse_links(run.evaluations, 2)
    write_atomic(run.evaluations / f"{checkpoint}.wanted", b"")
    for path in run.evaluations.glob("*.wanted"):
        if path.stem != checkpoint:
            path.unlink(missing_ok=True)


def release_from_evaluation(run: Run, checkpoint: str) -> None:
    """End the protection of :func:`keep_for_evaluation`. Raises DamagedFile if a link leads out of the run, OSError."""
    refuse_links(run.evaluations, 2)
    (run.evaluations / f"{checkpoint}.wanted").unlink(missing_ok=True)


def pending_checkpoints(run: Run) -> set[str]:
    """Names of the checkpoints of pending evaluations, from :func:`keep_for_evaluation`."""
    return {path.stem for path in run.evaluations.glob("*.wanted")}


def kept_checkpoints(run: Run) -> set[str]:
    """Names of the checkpoints that their evaluations protect from retention.

    These are the checkpoints of pending and finished evaluations, unless every evaluation of a checkpoint says that it need not be
    kept; of the latter, only the best.
    """
    # also what can't be read: keeping is safe
    kept = {checkpoint for _, checkpoint, summary in _summaries(run) if summary is None or summary.get("keep", True)}
    return kept | pending_checkpoints(run)


def in_one_line(summary: Mapping[str, Any]) -> str:
    """An evaluation in one line: the share of successes where the task declares what a success is, else how long its episodes lasted."""
    episodes, length, longest = (summary[key] for key in ("episodes", "mean_length", "max_length"))
    success, meant = _mapping(summary, "success"), summary.get("success_is")
    mean = f"mean return {summary['mean_return']:.2f}"
    if not success or not isinstance(meant, str) or meant == BY_CLOCK:
        share = f"{100 * length / longest:.0f} %"
        return f"mean episode length {length:.1f} of {longest} ({share}), {mean} over {counted(episodes, 'episode')}"
    shown = "".join(f"{name} {text}, " for name, text in _mapping(summary, "shown").items())
    count = success.get("count")
    return (
        f"{count} of {counted(episodes, 'episode')} succeeded ({_percent(success.get('share'))}: {meant}), {shown}"
        f"mean length {length:.1f} steps, {mean}"
    )


def kind_of(summary: Mapping[str, Any]) -> str:
    """The key of the job section that made an evaluation, which its summary has, too: ``evaluate`` where no plug-in has made it."""
    return next((key for key in sections() if _mapping(summary, key)), "evaluate")


def lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """An evaluation as lines of text."""
    if rules := rules_of(kind_of(summary)):
        yield from rules.lines(summary)
        return
    task, seed = summary.get("task"), summary.get("seed")
    yield f"{counted(summary['episodes'], 'episode')} of {task}, checkpoint {summary['checkpoint']}, seed {seed}"
    for place, value in changes_in_lines(summary):
        yield f"  with config.{place}: {value}"
    rewards, metrics = _mapping(summary, "rewards"), _mapping(summary, "metrics")
    largest = sorted(rewards, key=lambda name: -abs(_mapping(rewards, name).get("mean") or 0.0))
    terms = {f"reward {name}": _mapping(rewards, name) for name in largest[:TERMS_SHOWN]}
    terms |= {f"metric {name}": _mapping(metrics, name) for name in metrics}
    width = max(map(len, [*terms, 20 * " "]))
    yield f"{'':{width}} {'mean':>10} {'95 % interval':>24} {'std':>10}"
    success = _mapping(summary, "success")
    if success:
        ends = f"{_percent(success.get('low'))} to {_percent(success.get('high'))}"
        yield f"{'success':{width}} {_percent(success.get('share')):>10} {ends:>24} {'':10}  {summary.get('success_is', '')}"
    yield _row("return", _mapping(summary, "return"), width)
    yield f"{_row('length', _mapping(summary, 'length'), width)}  of at most {summary['max_length']}"
    for name, figures in terms.items():
        yield _row(name, figures, width)
    causes = _mapping(summary, "causes")
    ends = ", ".join(f"{name} {_mapping(causes, name).get('count')}" for name in causes)
    yield f"ended by: {ends}"
    if compared := _mapping(summary, "compared"):
        yield _comparison(compared)


def changes_in_lines(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """How the worlds of an evaluation differ from the training's, by place, each in one line: a longer text only by its size."""
    for place, value in flattened(_mapping(summary, "config")):
        rows = value.splitlines() if isinstance(value, str) else []
        yield place, counted(len(rows), "line") if len(rows) > 1 else str(value)


def flattened(config: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """The values of nested mappings, by their place: ``randomize.friction``."""
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            yield from ((f"{key}.{place}", each) for place, each in flattened(value))
        else:
            yield str(key), value


def _comparison(compared: Mapping[str, Any]) -> str:
    when = compared.get("time")
    date = time.strftime(" of %Y-%m-%d %H:%M", time.localtime(when)) if isinstance(when, int | float) else ""
    others = " in other worlds" if compared.get("other_worlds") else ""
    returns = _mapping(compared, "return")
    method = f"paired over {counted(returns['pairs'], 'episode')}" if isinstance(returns.get("pairs"), int) else "Welch"
    low, high, difference = (_number(returns.get(key), "+") for key in ("low", "high", "difference"))
    return (
        f"compared with the evaluation{date} of checkpoint {compared.get('checkpoint')}{others}: "
        f"return {difference} ({low} to {high}, {method}): {returns.get('verdict')}"
    )


def _row(name: str, figures: Mapping[str, Any], width: int) -> str:
    ends = f"{_number(figures.get('low'))} to {_number(figures.get('high'))}" if figures.get("low") is not None else "-"
    return f"{name:{width}} {_number(figures.get('mean')):>10} {ends:>24} {_number(figures.get('std')):>10}"


def _mapping(found: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """A mapping that any job may have written."""
    value = found.get(key)
    return value if isinstance(value, Mapping) else {}


def _number(value: Any, sign: str = "") -> str:
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "-"
    return format(value, f"{sign}.2f" if abs(value) >= 1 or value == 0 else f"{sign}.4f")


def _percent(value: Any) -> str:
    return f"{100 * value:.1f} %" if isinstance(value, int | float) else "-"
