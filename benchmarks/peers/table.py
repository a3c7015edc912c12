"""The table of all records: steps a second, ratios to Muster, start-up, and tracking errors over wall time.

    python -m benchmarks.peers.table [--records DIRECTORY] [--out FILE]

Reads the records of the peers' commands, and ``judged/`` of :mod:`benchmarks.peers.judge` if it exists; prints Markdown, or writes it to
``--out``.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.load import reported
from benchmarks.peers.cases import find_case
from benchmarks.peers.judge import read_record
from benchmarks.peers.run import RECORDS

Record = dict[str, Any]
OURS = "Muster"
NAMES = {"muster": OURS, "mjlab": "mjlab", "isaaclab": "Isaac Lab", "rsl_rl": "rsl_rl's runner on Muster"}
PACKAGES = {"muster": "muster", "mjlab": "mjlab", "isaaclab": "isaaclab", "rsl_rl": "rsl-rl-lib"}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers.table",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--records", type=Path, default=RECORDS)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    try:
        text = table(*read_all(options.records))
    except ValueError as error:
        parser.error(str(error))
    if options.out:
        options.out.write_text(text)
    else:
        print(text, end="")


def read_all(directory: Path) -> tuple[list[Record], list[Record]]:
    """The records of trainings and the judgements in a folder. Raises ValueError without any, or if one can't be read."""
    records = [read_record(path) for path in sorted(directory.glob("*.json"))]
    if not records:
        raise ValueError(
            f"there are no records in {directory}; python -m benchmarks.peers.muster writes one, for example"
        )
    judged = [json.loads(path.read_text()) for path in sorted((directory / "judged").glob("*.json"))]
    return records, judged


def table(records: Sequence[Record], judged: Sequence[Record] = ()) -> str:
    """Markdown of the records, and of any judgements."""
    lines = [
        "# Muster and its peers",
        "",
        "Steps a second by the clock, with logging and checkpoints, after the first iterations, each training in a process of its own; of "
        "several *runs* the median, the least and the greatest in brackets. The ratio is Muster's (algorithm `ppo`) to that row. Ready: from "
        "the start of the process to the first iteration (imports, worlds, compiled kernels). How it was measured: "
        f"[README](README.md). {reported(records)}",
    ]
    for device in _distinct(record["device"] for record in records):
        lines += ["", f"## On {device}", ""]
        lines += _rates([record for record in records if record["device"] == device])
    if judged:
        lines += ["", "## What the policies are worth", "", *_judgements(judged)]
    return "\n".join(lines) + "\n"


def _rates(records: Sequence[Record]) -> list[str]:
    lines = [
        "| case | solver limits | worlds | system | runs | steps/s | ratio | collect | learn | ready | first iteration |",
        "|---|---|--:|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for setting in _distinct(_setting(record) for record in records):
        of_it = [record for record in records if _setting(record) == setting]
        groups = {name: [record for record in of_it if label(record) == name] for name in _distinct(map(label, of_it))}
        ours = next((middle(group, "rate") for group in groups.values() if _is_ours(group[0])), None)
        # ours first, then the fastest
        for name, group in sorted(
            groups.items(), key=lambda item: (not _is_ours(item[1][0]), -middle(item[1], "rate"))
        ):
            lines.append(_row(setting, name, group, ours))
    return lines


def _row(setting: tuple[Any, ...], name: str, group: Sequence[Record], ours: float | None) -> str:
    case, limits, worlds = setting
    own = find_case(case).limits(limits)
    rates = [record["rate"] for record in group]
    rate = statistics.median(rates)
    spread = f" ({min(rates):,.0f} to {max(rates):,.0f})" if len(rates) > 1 else ""
    ratio = "–" if ours is None or _is_ours(group[0]) else f"{ours / rate:.1f} ×"
    parts = (
        statistics.median(point[part] for record in group for point in _counted(record))
        for part in ("collect_s", "learn_s")
    )
    times = " | ".join(f"{1000 * part:,.0f} ms" for part in parts)
    return (
        f"| {case} | {limits} ({own.iterations}/{own.ls_iterations}, {own.tolerance:g}) | {worlds:,} | {name} | {len(group)} | "
        f"{rate:,.0f}{spread} | {ratio} | {times} | {middle(group, 'startup_s'):.1f} s | {middle(group, 'first_s'):.1f} s |"
    )


def _judgements(judged: Sequence[Record]) -> list[str]:
    lines = [
        "Mean actions of all systems in the same worlds of Muster's task, with noise, pushes and randomisation. Linear: distance "
        "from the commanded velocity in the plane; angular: from the commanded turning velocity. As good as: training time after which "
        "both errors of a training by Muster with the same case were no greater, and its episodes no shorter, than those of the peer's "
        "last policy, and how many times longer the peer took to its own.",
        "",
        "| case | trained by | its limits | judged under | seed | after | steps | linear | angular | length | Muster as good as |",
        "|---|---|---|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for one in sorted(judged, key=lambda one: (one["case"], not _is_ours(one), label(one), one["limits"], one["seed"])):
        last = one["rows"][-1]
        lines.append(
            f"| {one['case']} | {label(one)} | {one['limits']} | {one['judged_limits']} | {one['seed']} | {last['seconds']:.1f} s | "
            f"{last['env_steps'] / 1e6:.1f} M | {last['linear_error']:.3f} m/s | {last['angular_error']:.3f} rad/s | "
            f"{100 * last['length_share']:.1f} % | {_as_good(one, judged)} |"
        )
    return lines


def _as_good(peer: Record, judged: Iterable[Record]) -> str:
    """Median training time after which Muster was as good as the peer's last policy, over the trainings that reached it."""
    if _is_ours(peer):
        return "–"
    goal = peer["rows"][-1]
    same = [
        one
        for one in judged
        if _is_ours(one) and all(one[key] == peer[key] for key in ("case", "device", "judged_limits"))
    ]
    times = [at for one in same if (at := reached(one["rows"], goal)) is not None]
    if not times:
        return "–" if not same else f"0 of {len(same)}"
    took = statistics.median(times)
    return f"{took:.1f} s ({goal['seconds'] / took:.1f} ×), {len(times)} of {len(same)}"


def reached(rows: Iterable[Record], goal: Record) -> float | None:
    """Training time of the first row that is as good as ``goal`` in every respect [s]; None without any."""
    for row in rows:
        errors = all(row[name] <= goal[name] for name in ("linear_error", "angular_error"))
        if errors and row["length_share"] >= goal["length_share"]:
            return float(row["seconds"])
    return None


def label(record: Record) -> str:
    """Label of a record's system, with its version, front end and algorithm if known."""
    name = NAMES.get(record["peer"], record["peer"])
    version = record.get("versions", {}).get(PACKAGES.get(record["peer"], ""))
    more = [record[key] for key in ("frontend", "algorithm") if record.get(key)]
    shown = f" {version}" if version and record["peer"] != "muster" else ""
    return f"{name}{shown}" + (f" ({', '.join(more)})" if more else "")


def middle(group: Sequence[Record], key: str) -> float:
    """Median of a figure of these records."""
    return float(statistics.median(record[key] for record in group))


def _is_ours(record: Record) -> bool:
    return bool(record["peer"] == "muster" and record.get("algorithm", "ppo") == "ppo")


def _setting(record: Record) -> tuple[Any, ...]:
    return record["case"], record["limits"], record["worlds"]


def _counted(record: Record) -> list[Record]:
    """Points of the curve that the rate counts."""
    first = record["warm"] * record["worlds"] * record["steps"]
    return [point for point in record["curve"] if point["env_steps"] > first] or record["curve"][-1:]


def _distinct(values: Iterable[Any]) -> list[Any]:
    return list(dict.fromkeys(values))


if __name__ == "__main__":
    main()
