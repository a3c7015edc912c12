"""``sac`` and ``ppo`` on this device: steps and seconds until the mean return of finished episodes reaches a goal.

    python -m benchmarks.sac [--tasks Cartpole Ant Humanoid] [--seeds 0 1 2] [--out DIRECTORY]

Each task is trained with its own settings of both. The clock starts with the first iteration, so it includes the capture of graphs but
not the construction of worlds. Writes ``sac.md``, ``sac.json``, and ``sac.png`` where matplotlib is installed.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.curves import worth
from benchmarks.load import Watch, add_option, reported
from benchmarks.training import build, device_name

PLAN: dict[str, tuple[dict[str, int], float, tuple[float, ...]]] = {
    "Cartpole": ({"sac": 1024, "ppo": 4096}, 6.0, (20.0, 26.0)),
    "Ant": ({"sac": 4096, "ppo": 4096}, 28.0, (2000.0, 6000.0, 12000.0)),
    "Humanoid": ({"sac": 4096, "ppo": 4096}, 45.0, (2000.0, 5000.0, 7000.0)),
}
"""By task: worlds of each algorithm, seconds of training, and the returns to be reached."""


def train(task: str, algorithm: str, seed: int, judged: bool) -> dict[str, Any]:
    """The curve: seconds, steps and mean return after each iteration; if ``judged``, also the final policy's evaluation."""
    worlds, limit, _ = PLAN[task]
    with tempfile.TemporaryDirectory() as store:
        loop = build(task, worlds[algorithm], Path(store), seed, algorithm=algorithm)
        curve: list[tuple[float, int, float]] = []
        started = time.perf_counter()
        while (seconds := time.perf_counter() - started) < limit:
            record = loop._iterate()[0]
            if record["episodes"]:
                curve.append((round(seconds, 3), record["env_steps"], round(record["reward"], 2)))
        found = worth(loop) if judged else {}
        loop.close()
    reported = {
        "task": task,
        "algorithm": algorithm,
        "worlds": worlds[algorithm],
        "seed": seed,
        "device": device_name(),
    }
    return reported | found | {"curve": curve}


def thinned(row: dict[str, Any]) -> dict[str, Any]:
    """The row with about 300 points of its curve."""
    return row | {"curve": row["curve"][:: max(1, len(row["curve"]) // 300)]}


def reached(curve: list[tuple[float, int, float]], goal: float) -> tuple[float, int] | None:
    """Seconds and steps when the mean of ten consecutive iterations reached ``goal``; None if it never did."""
    for end in range(10, len(curve) + 1):
        if statistics.fmean(point[2] for point in curve[end - 10 : end]) >= goal:
            return curve[end - 1][0], curve[end - 1][1]
    return None


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: medians over the seeds, with the worst in brackets."""
    lines = [
        f"# sac and ppo on {rows[0]['device']}",
        "",
        "Seconds and million steps until ten iterations in a row had the stated mean return, medians over seeds, the worst seed in "
        f"brackets; `python -m benchmarks.sac`. {reported(rows)} ![return against time](sac.png)",
        "",
        "| task | algorithm | worlds | return | seeds that reached it | seconds | million steps |",
        "|---|---|--:|--:|--:|--:|--:|",
    ]
    for task, algorithm in dict.fromkeys((row["task"], row["algorithm"]) for row in rows):
        its = [row for row in rows if (row["task"], row["algorithm"]) == (task, algorithm)]
        for goal in PLAN[task][2]:
            found = [at for row in its if (at := reached(row["curve"], goal))]
            seconds = (
                f"{statistics.median(at[0] for at in found):.1f} ({max(at[0] for at in found):.1f})" if found else "–"
            )
            steps = f"{statistics.median(at[1] for at in found) / 1e6:.1f}" if found else "–"
            lines.append(
                f"| {task} | {algorithm} | {its[0]['worlds']:,} | {goal:,.0f} | {len(found)} of {len(its)} | {seconds} | {steps} |"
            )
    lines += [
        "",
        "What the first seed's policy is worth in the end: its mean action from fresh starts, in worlds as it was trained in, and in "
        "worlds with MuJoCo's own limits of the solver.",
        "",
        "| task | algorithm | after | return | under MuJoCo's own limits | length |",
        "|---|---|--:|--:|--:|--:|",
    ]
    for row in rows:
        if "evaluated" in row:
            exact = f"{row['reference']:,.1f}" if "reference" in row else "–"
            lines.append(
                f"| {row['task']} | {row['algorithm']} | {PLAN[row['task']][1]:.0f} s | {row['evaluated']:,.1f} | {exact} | "
                f"{row['evaluated_length']:.0f} of {row['longest']} |"
            )
    return "\n".join(lines) + "\n"


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Plot mean return against time, one panel per task; do nothing without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot

    tasks = list(dict.fromkeys(row["task"] for row in rows))
    figure, panels = pyplot.subplots(1, len(tasks), figsize=(4 * len(tasks), 3), squeeze=False)
    colors = {"ppo": "tab:blue", "sac": "tab:orange"}
    for row in rows:
        panel = panels[0][tasks.index(row["task"])]
        label = row["algorithm"] if row["seed"] == min(each["seed"] for each in rows) else None
        panel.plot(
            *zip(*((at[0], at[2]) for at in row["curve"]), strict=True), color=colors[row["algorithm"]], label=label
        )
        panel.set_title(row["task"])
        panel.set_xlabel("seconds")
        panel.legend()
    panels[0][0].set_ylabel("mean return")
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(PLAN), choices=list(PLAN))
    parser.add_argument("--algorithms", nargs="+", default=["sac", "ppo"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    options = parser.parse_args()
    watch, rows = Watch(options.loaded_anyway), list[dict[str, Any]]()
    for task in options.tasks:
        for algorithm in options.algorithms:
            for seed in options.seeds:
                judged = seed == options.seeds[0]
                rows.append(train(task, algorithm, seed, judged) | watch.check(f"while {task} was trained"))
                print(task, algorithm, seed, rows[-1]["curve"][-1:], flush=True)
                (options.out / "sac.json").write_text(json.dumps([thinned(row) for row in rows]))
                (options.out / "sac.md").write_text(table(rows))
    draw(rows, options.out / "sac.png")


if __name__ == "__main__":
    main()
