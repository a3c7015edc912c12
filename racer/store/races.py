"""Races: the rules from a job's ``race`` section, their changes of the task's configuration, and the result as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from shared_store.contract.error_text import counted

TRIALS = 3
"""Laps of a race, by default."""
SIM_TRACE = "sim-trace"
"""Directory of step logs: of a race in that of its evaluation, of a training in that of the run."""
BESIDE = ("model", "ip")
"""Directories beside it, with the action space and the hyperparameters."""
DEFAULTS: Mapping[str, Any] = {
    "continuous": False,
    "off_track_penalty": 1.0,
    "crash_penalty": 1.0,
    "max_resets": 100,
    "seconds": 1200.0,
}
"""Rules that a ``race`` section may change."""
NO_RACER = "which drives no laps; race only runs of a racer's task, such as Racer"
"""The reason why a run can't race; follows the name of its task."""
_FROM_THE_LINE = {"start": "line", "start_sideways": [0.0, 0.0], "start_turned": [0.0, 0.0]}


def rules_of(section: Mapping[str, Any]) -> dict[str, Any]:
    """The rules of a race, as in its result; a league sets ``ranking``."""
    rules = {key: section.get(key, value) for key, value in DEFAULTS.items()}
    return {"laps": section.get("trials", TRIALS), **rules, "ranking": None}


def race_changes(section: Mapping[str, Any]) -> dict[str, Any]:
    """A race's changes of its run's training configuration: those of its section, overridden by its rules.

    Args:
        section: ``race`` of a job YAML.
    """
    rules = {key: section.get(key, value) for key, value in DEFAULTS.items()}
    rules["episode_seconds"] = rules.pop("seconds")
    track = {"track": section["track"]} if section.get("track") else {}
    fixed = {**_FROM_THE_LINE, "alternate_direction": False, "trace": True}
    return {**(section.get("config") or {}), **track, **fixed, **rules}


def key_of(section: Mapping[str, Any], path: tuple[str | int, ...]) -> str:
    """The key in the job from which a value of the changed configuration comes."""
    first = "seconds" if path[:1] == ("episode_seconds",) else path[0] if path else ""
    place = ("race",) if first in DEFAULTS or (first == "track" and section.get("track")) else ("race", "config")
    return ".".join(map(str, (*place, first, *path[1:])))


def lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """The race in the summary of an evaluation, as lines of text."""
    race: Mapping[str, Any] = summary["race"]
    rules, trials = race["rules"], race["trials"]
    yield (
        f"race: {counted(rules['laps'], 'lap')} of {summary.get('task')} on {', '.join(race['track'])}, "
        f"checkpoint {summary['checkpoint']}, seed {summary.get('seed')}"
    )
    put = (
        f"put back, {rules['max_resets']} times at most"
        if rules["continuous"]
        else "a lap ends with the first incident"
    )
    penalties = f"{rules['off_track_penalty']:g} s off the track, {rules['crash_penalty']:g} s for a crash"
    yield f"rules: {put}; {penalties}; {rules['seconds']:g} s for a lap"
    yield f"{'TRIAL':>5} {'TIME':>10} {'COMPLETED':>9} {'STATUS':<12} {'OFF-TRACKS':>10} {'CRASHES':>7} {'RESETS':>6}"
    for trial in trials:
        yield (
            f"{trial['trial']:>5} {clock(trial['time']):>10} {trial['completion']:>7.1f} % {trial['status']:<12} "
            f"{trial['off_tracks']:>10} {trial['crashes']:>7} {trial['resets']:>6}"
        )
    best, average, total = (clock(race[key]) for key in ("best_lap", "average_lap", "total_time"))
    yield f"{race['completed']} of {counted(len(trials), 'lap')} complete: best {best}, average {average}, total {total}"


def clock(seconds: float | None) -> str:
    """A time as minutes, seconds and milliseconds, ``1:02.345``; a dash for None."""
    if seconds is None:
        return "-"
    minutes, rest = divmod(round(seconds * 1000), 60_000)
    return f"{minutes}:{rest // 1000:02d}.{rest % 1000:03d}"
