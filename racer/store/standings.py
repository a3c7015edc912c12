"""The standings of a racer's league: counted times, ties, entries without a rank. Pure functions.

All times are simulated, include penalties, and are compared in whole milliseconds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

from shared_store.contract.error_text import counted, shown

Ranking = Literal["total", "best", "average"]
RANKINGS: tuple[Ranking, ...] = get_args(Ranking)
Status = Literal["ranked", "slower", "incomplete", "disqualified", "altered"]
LAP_COMPLETE = "lap_complete"
"""Status of a trial that is a whole lap."""

_COMPARED = ("status", "completion", "lap_time", "time", "off_tracks", "crashes", "immobilized", "reversed", "resets")
"""The results that two races of one policy on one seed share, trial by trial."""


class BadRace(ValueError):
    """An evaluation is not a race, or not by these rules; one line."""


@dataclass(frozen=True)
class RaceResults:
    """The counted results of a race.

    Attributes:
        laps: Number of laps in the race.
        times: Time of each complete lap, with its penalties [s].
        resets: Number of times that the car was put back.
        off_tracks: Number of times that it left the road.
        crashes: Number of times that it touched an obstacle.
    """

    laps: int
    times: tuple[float, ...]
    resets: int
    off_tracks: int
    crashes: int

    @property
    def best(self) -> int | None:
        """The fastest lap [ms]."""
        return _milliseconds(min(self.times)) if self.times else None

    def counts(self, ranking: Ranking) -> int | None:
        """The time by which it is ranked [ms]; None without one.

        ``total`` requires all laps to be complete; ``best`` and ``average`` are over the complete ones.
        """
        if not self.times or (ranking == "total" and len(self.times) < self.laps):
            return None
        if ranking == "best":
            return self.best
        total = math.fsum(self.times)  # from the exact times: rounded ones would give another sum
        return _milliseconds(total if ranking == "total" else total / len(self.times))


def read_race(race: Any) -> RaceResults:
    """The counted results in the key ``race`` of an evaluation's summary. Raises BadRace."""
    if not isinstance(race, Mapping):
        raise BadRace("it is not a race: its summary has no key race")
    rules, trials = race.get("rules"), race.get("trials")
    laps = rules.get("laps") if isinstance(rules, Mapping) else None
    if not isinstance(laps, int) or not isinstance(trials, list) or len(trials) != laps:
        raise BadRace(f"race: expected rules.laps and as many trials, found laps {shown(laps)}")
    counts = {"off_tracks": 0, "resets": 0, "crashes": 0}
    times = []
    for number, trial in enumerate(trials, 1):
        where = f"race.trials.{number - 1}"
        if not isinstance(trial, Mapping) or trial.get("trial") != number or not isinstance(trial.get("status"), str):
            raise BadRace(f"{where}: expected trial {number} with its status, found {shown(trial)}")
        for key in counts:
            value = trial.get(key)
            if not isinstance(value, int) or isinstance(value, bool) or value < 0:
                raise BadRace(f"{where}.{key}: expected an integer, found {shown(value)}")
            counts[key] += value
        if trial["status"] == LAP_COMPLETE:
            times.append(_lap_time(trial.get("time"), f"{where}.time"))
    return RaceResults(laps=laps, times=tuple(times), **counts)


def _lap_time(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise BadRace(f"{where}: expected the lap's time in seconds, found {shown(value)}")
    return float(value)


def _milliseconds(seconds: float) -> int:
    return round(1000 * seconds)


def differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """The differences between two races of one policy, a line each; none if every lap is bitwise the same.

    Args:
        before: The key ``race`` of a summary, such as an entry's.
        after: That of another evaluation.
    """
    lines = [
        f"{key}: {shown(before.get(key))} became {shown(after.get(key))}"
        for key in ("rules", "track", "direction")
        if before.get(key) != after.get(key)
    ]
    old, new = before.get("trials") or [], after.get("trials") or []
    if len(old) != len(new):
        return [*lines, f"{counted(len(old), 'trial')} became {len(new)}"]
    for number, (one, other) in enumerate(zip(old, new, strict=True), 1):
        for key in _COMPARED:
            if one.get(key) != other.get(key):
                lines.append(f"trial {number}: {key} {one.get(key)} became {other.get(key)}")
    return lines


@dataclass(frozen=True)
class Contender:
    """An entry, with the data for the table.

    Attributes:
        entry: Its number; numbers count up from 1 in the order of creation.
        racer: Name of the racer.
        model: ``NAME@VERSION``.
        race: None if the entry is altered.
        disqualified: The reason for its disqualification; empty without one.
        problem: The error in its files; empty without one.
    """

    entry: int
    racer: str
    model: str
    race: RaceResults | None
    disqualified: str = ""
    problem: str = ""


@dataclass(frozen=True)
class Row:
    """A line of the table; times in seconds, to the millisecond."""

    rank: int | None
    entry: int
    racer: str
    model: str
    status: Status
    time: float | None
    best_lap: float | None
    completed: int | None
    laps: int | None
    off_tracks: int | None
    crashes: int | None
    resets: int | None
    reason: str = ""

    def document(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)


def table(contenders: Sequence[Contender], ranking: Ranking, *, every: bool = False) -> list[Row]:
    """The standings: ranked rows first, then the others.

    If a racer has several entries, the best one is ranked. Fewer resets break ties, then fewer off-tracks, then the earlier entry, so
    that no two entries share a rank.

    Args:
        contenders: All entries.
        ranking: The ranking criterion.
        every: Whether a racer's other entries are also rows.
    """
    timed: list[tuple[tuple[int, int, int, int], Contender]] = []
    others: list[Row] = []
    for each in contenders:
        time = each.race.counts(ranking) if each.race else None
        if each.problem or each.race is None:
            others.append(_row(each, "altered", None, each.problem))
        elif each.disqualified:
            others.append(_row(each, "disqualified", time, each.disqualified))
        elif time is None:
            reason = f"{len(each.race.times)} of {counted(each.race.laps, 'lap')} complete"
            others.append(_row(each, "incomplete", None, reason))
        else:
            timed.append(((time, each.race.resets, each.race.off_tracks, each.entry), each))
    ranked: list[Row] = []
    for (time, *_), each in sorted(timed, key=lambda pair: pair[0]):
        first = next((row for row in ranked if row.racer == each.racer), None)
        if first is None:
            ranked.append(replace(_row(each, "ranked", time), rank=len(ranked) + 1))
        elif every:
            others.append(_row(each, "slower", time, f"entry {first.entry} of the same racer is ranked"))
    order = ("slower", "incomplete", "disqualified", "altered")
    shown_alone = {row.racer for row in ranked}
    kept = [row for row in others if every or row.status != "incomplete" or row.racer not in shown_alone]
    return [*ranked, *sorted(kept, key=lambda row: (order.index(row.status), row.entry))]


def _row(each: Contender, status: Status, time: int | None, reason: str = "") -> Row:
    race = each.race
    return Row(
        rank=None,
        entry=each.entry,
        racer=each.racer,
        model=each.model,
        status=status,
        time=_seconds(time),
        best_lap=_seconds(race.best) if race else None,
        completed=len(race.times) if race else None,
        laps=race.laps if race else None,
        off_tracks=race.off_tracks if race else None,
        crashes=race.crashes if race else None,
        resets=race.resets if race else None,
        reason=reason,
    )


def _seconds(milliseconds: int | None) -> float | None:
    return None if milliseconds is None else milliseconds / 1000
