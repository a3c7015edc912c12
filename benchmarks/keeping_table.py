"""The table and the picture of ``benchmarks.keeping``: what the curves of its trainings come to."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PLAN: dict[str, tuple[int, float]] = {
    **dict.fromkeys(("cartpole", "racer", "my-task"), (10, 10)),
    **dict.fromkeys(("cartpole-pixels", "ant", "humanoid"), (3, 5)),
    **dict.fromkeys(("quadruped", "go1-flat", "g1-flat"), (2, 2)),
    **dict.fromkeys(
        ("racer-pixels", "lift-cube", "lift-cubes", "go1-rough", "g1-rough", "g1-walk", "g1-rough-walk"), (1, 1)
    ),
}
"""By spec: seeds, and how many times its iterations."""
ON_CPU = ("cartpole", "racer", "my-task")
WORLDS = {"ant": 4096}
"""Instead of a spec's worlds: with these the ant learns to run, as its spec says."""
POINTS = 200
"""Points of a curve."""
KINDS = ("default", "then", "stock")
KEPT_COLUMNS = ("iteration", "episodes", "reward", "action_std")
"""Those that ``keeping.json`` keeps of a point."""
Curve = list[dict[str, Any]]
Key = tuple[str, str, int, int]
"""Spec, settings, seed, iterations."""


def curves_of(directory: Path) -> dict[Key, Curve]:
    """The points of each training in ``keeping.json`` and ``keeping.jsonl``; of a training that was begun twice, those of the last time."""
    found: dict[Key, Curve] = {}
    kept, new = directory / "keeping.json", directory / "keeping.jsonl"
    for curve in json.loads(kept.read_text()) if kept.exists() else ():
        key = curve["spec"], curve["by"], curve["seed"], curve["iterations"]
        found[key] = [dict(zip(KEPT_COLUMNS, point, strict=True)) for point in curve["points"]]
    for line in new.read_text().splitlines() if new.exists() else ():
        point = json.loads(line)
        key = point["spec"], point["by"], point["seed"], point["iterations"]
        points = found.setdefault(key, [])
        if points and point["iteration"] <= points[-1]["iteration"]:
            points.clear()
        points.append(point)
    return found


def keep(curves: Mapping[Key, Curve], path: Path) -> None:
    """Write the finished trainings, with the columns that the table needs; one a line."""
    lines = []
    for key, points in sorted(curves.items()):
        if is_whole(key, points):
            rows = [[short(point.get(name)) for name in KEPT_COLUMNS] for point in points]
            head = dict(zip(("spec", "by", "seed", "iterations"), key, strict=True))
            lines.append(json.dumps({**head, "points": rows}, separators=(",", ":")))
    path.write_text("[\n" + ",\n".join(lines) + "\n]\n")


def short(value: Any) -> Any:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def is_whole(key: Key, curve: Curve) -> bool:
    """Whether a training came to its end."""
    return bool(curve[-1]["iteration"] >= key[3] - key[3] // POINTS)


WIDTH = 0.05
"""Share of a training over which returns are averaged."""
KEPT = 0.9
"""Least share of the best mean that the last one has."""


@dataclass
class Outcome:
    """What a curve comes to: mean returns over :data:`WIDTH` of the training, weighted by episodes."""

    first: float
    best: float
    end: float

    @property
    def kept(self) -> float:
        """The last mean as a share of the best one, of returns below 0 as a share of the gain."""
        if self.best > 0:
            return self.end / self.best
        return (self.end - self.first) / (self.best - self.first) if self.best > self.first else 1.0

    @classmethod
    def of(cls, curve: Curve) -> Outcome:
        width = max(1, round(WIDTH * len(curve)))
        windows = [curve[at : at + width] for at in range(len(curve) - width + 1)]
        means = [weighed for window in windows if (weighed := weighted(window)) is not None]
        return cls(means[0], max(means), means[-1])


def weighted(points: Curve) -> float | None:
    """Mean return of the episodes of some points; None without any."""
    episodes = sum(point["episodes"] for point in points)
    return (
        sum(point["episodes"] * point["reward"] for point in points if point["episodes"]) / episodes
        if episodes
        else None
    )


def reached(curve: Curve, goal: float) -> int | None:
    """Iterations until the mean return of a point was ``goal``."""
    return next((point["iteration"] for point in curve if point["episodes"] and point["reward"] >= goal), None)


def dipped(curve: Curve) -> bool:
    """Whether a mean over :data:`WIDTH` fell below :data:`KEPT` of the best one after another had reached that."""
    width = max(1, round(WIDTH * len(curve)))
    means = [mean for at in range(len(curve) - width + 1) if (mean := weighted(curve[at : at + width])) is not None]
    goal = KEPT * max(means)
    reached = next(at for at, mean in enumerate(means) if mean >= goal)
    return min(means[reached:]) < goal


def median(values: list[float]) -> float:
    ordered = sorted(values)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2


def table(curves: Mapping[Key, Curve]) -> str:
    """Markdown: a row for each spec and kind of settings, over its seeds."""
    whole = {key: curve for key, curve in curves.items() if is_whole(key, curve)}
    lines = [
        "# Do trainings keep what they learnt?",
        "",
        f"`python -m benchmarks.keeping`, {', '.join(ON_CPU)} on one core each, the others on a GPU, ant with {WORLDS['ant']:,} worlds. Mean returns are over {WIDTH:.0%} of a training, weighted by episodes; *kept* is the last of "
        "these means as a share of the best one. *Dipped*: seeds with a mean below 90 % of the best one at any time after it had been "
        "there. *To 90 %*: iterations until a two-hundredth of the training had 90 % of the median best mean of the default settings.",
        "",
        "`default` are the settings of a new job; `then` those of runs that began before deviations and rates had limits; `stock` is "
        "rsl_rl's own runner with the settings of `then`. The other rows are what the defaults were chosen from: *floor* is `min_std` (0.1 "
        "where not named), *horizon* `learning_rate_horizon`, *normaliser* `normalizer_horizon`.",
        "",
        "![mean return of every seed](keeping.png)",
        "",
        f"| spec | by | seeds | iterations | seeds that kept {KEPT:.0%} | worst | dipped | median best | median end | to 90 % (worst) | deviation at the end |",
        "|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for spec in (spec for spec in PLAN if any(key[0] == spec for key in whole)):
        of_spec = {key: curve for key, curve in whole.items() if key[0] == spec}
        usual = [Outcome.of(curve).best for key, curve in of_spec.items() if key[1] == "default"]
        goal = KEPT * median(usual) if usual else None
        for by, iterations in dict.fromkeys((key[1], key[3]) for key in sorted(of_spec, key=_rank)):
            its = [curve for key, curve in of_spec.items() if (key[1], key[3]) == (by, iterations)]
            outcomes = [Outcome.of(curve) for curve in its]
            kept = [outcome.kept for outcome in outcomes]
            times = [at for curve in its if goal is not None and (at := reached(curve, goal)) is not None]
            soon = (
                f"{median([float(at) for at in times]):.0f} ({max(times)})"
                if len(times) == len(its)
                else f"{len(times)} of {len(its)}"
            )
            deviations = [curve[-1]["action_std"] for curve in its if curve[-1].get("action_std") is not None]
            deviation = f"{min(deviations):.2g} to {max(deviations):.2g}" if deviations else "–"
            lines.append(
                f"| {spec} | {by} | {len(its)} | {iterations:,} | {sum(each >= KEPT for each in kept)} | {min(kept):.0%} | {sum(map(dipped, its))} | "
                f"{median([each.best for each in outcomes]):,.1f} | {median([each.end for each in outcomes]):,.1f} | {soon} | {deviation} |"
            )
    return "\n".join(lines) + "\n"


def _rank(key: Key) -> int:
    return KINDS.index(key[1]) if key[1] in KINDS else len(KINDS)


def draw(curves: Mapping[Key, Curve], path: Path) -> None:
    """Plot the mean return of every seed, a panel for each spec and each of :data:`KINDS`."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    curves = {key: curve for key, curve in curves.items() if key[1] in KINDS}
    panels = list(
        dict.fromkeys(key[:2] for key in sorted(curves, key=lambda key: (list(PLAN).index(key[0]), _rank(key))))
    )
    columns = min(4, len(panels))
    rows = -(-len(panels) // columns)
    figure, places = pyplot.subplots(rows, columns, figsize=(4 * columns, 2.6 * rows), squeeze=False)
    for place in places.flat[len(panels) :]:
        place.axis("off")
    for key, curve in curves.items():
        place = places.flat[panels.index(key[:2])]
        points = [(point["iteration"], point["reward"]) for point in curve if point["episodes"]]
        place.plot(*zip(*points, strict=True), linewidth=0.7)
        place.set_title(f"{key[0]}, {key[1]}", fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
