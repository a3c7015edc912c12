"""Races as an evaluation's summary has them, and leagues for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from racer.store.leagues import League, Rules
from racer.store.races import race_changes

RULES = asdict(Rules()) | {"ranking": None}
CONFIG = race_changes(League("cup", ("oval",), Rules(), 7, "user ada", 1000.0).section())
"""What a race of :func:`league` changes of the configuration."""


def league(name: str = "cup", **changes: Any) -> League:
    """A league of three laps of the oval."""
    facts = {"track": ("oval",), "rules": Rules(), "seed": 7, "owner": "user ada", "created": 1000.0}
    return League(name=name, **{**facts, **changes})


def race(times: Sequence[float | None], off_tracks: int = 0, resets: int = 0, **rules: Any) -> dict[str, Any]:
    """A race of these lap times with penalties [s], None for a lap that is not complete; all that went wrong did so in the first lap."""
    trials = []
    for number, time in enumerate(times, 1):
        wrong = number == 1
        trials.append(
            {
                "trial": number,
                "status": "off_track" if time is None else "lap_complete",
                "completion": 40.0 if time is None else 100.0,
                "lap_time": None if time is None else time - off_tracks * wrong,
                "time": time,
                "off_tracks": off_tracks * wrong,
                "crashes": 0,
                "immobilized": 0,
                "reversed": 0,
                "resets": resets * wrong,
                "penalty": float(off_tracks * wrong),
                "steps": 185,
                "seed": 7,
            }
        )
    whole = [time for time in times if time is not None]
    return {
        "rules": {**RULES, "laps": len(times), **rules},
        "track": ["oval"],
        "direction": "counter-clockwise",
        "trials": trials,
        "completed": len(whole),
        "total_time": sum(whole) if len(whole) == len(times) else None,
        "best_lap": min(whole, default=None),
        "average_lap": sum(whole) / len(whole) if whole else None,
        "off_tracks": off_tracks,
        "crashes": 0,
        "resets": resets,
    }


def summary(driven: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """An evaluation's summary with a race."""
    figures = {"mean_return": 100.0, "mean_length": 185.0, "max_length": 18_000, "episodes": 3, "time": 2000.0}
    facts = {"task": "Racer", "seed": 7, "config": dict(CONFIG), "versions": {"warp": "1.0"}, "race": driven}
    return {**figures, **facts, **changes}


def entry(racer: str = "ada", owner: str = "", version: int = 1, **changes: Any) -> dict[str, Any]:
    """What is handed in for an entry, each of another evaluation."""
    facts = {
        "racer": racer,
        "owner": owner or f"user {racer}",
        "model": {"name": "fast", "version": version, "digest": "0" * 64, "task": "Racer"},
        "evaluation": {"run": "racer", "name": f"00000009-e1-{version}", "job": f"job-{version}", "time": 2000.0},
        "versions": {"warp": "1.0"},
        "race": race([12.0, 12.5, 13.0]),
    }
    return {**facts, **changes}
