"""The page of all numbers of the robots' tasks, written from their declarations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from worker.tasks import find_task
from worker.tasks.compile.tables import Row, numbers, tables

FAMILIES: Mapping[str, tuple[str, ...]] = {
    "Go1 and G1": ("Go1Flat", "Go1Rough", "G1Flat", "G1Rough"),
    "The arm": ("LiftCube", "LiftCubes"),
}
MJLAB: Mapping[str, Mapping[str, int | None]] = {
    "Go1Flat": {"iterations": 10, "ls_iterations": 20, "nconmax": None, "njmax": 300},
    "Go1Rough": {"iterations": 10, "ls_iterations": 20, "nconmax": 35, "njmax": 1500},
    "G1Flat": {"iterations": 10, "ls_iterations": 20, "nconmax": None, "njmax": 300},
    "G1Rough": {"iterations": 10, "ls_iterations": 20, "nconmax": 70, "njmax": 1500},
    "LiftCube": {"iterations": 10, "ls_iterations": 20, "nconmax": 55, "njmax": 600},
    "LiftCubes": {"iterations": 10, "ls_iterations": 20, "nconmax": 415, "njmax": 600},
}
"""Solver options of mjlab 1.6's task; None: MuJoCo Warp chooses."""

HEAD = """\
# Settings of the robots' tasks

Every default number of `Go1Flat`, `Go1Rough`, `G1Flat`, `G1Rough`, `LiftCube` and `LiftCubes`. An empty cell means that the task does not
have that row. [tasks.md](../tasks.md#go1flat-go1rough-g1flat-g1rough) explains the terms, the differences from mjlab, and the settings
that a job's YAML can change. `python -m docs.tools` writes this page from the declarations. For any task, `muster tasks
NAME` prints its terms with their numbers, its configuration and the curriculum of that; not the settings of its training (networks, PPO),
and not the solver's options.
"""


@dataclass(frozen=True)
class Sketch:
    """A task without worlds: its configuration, the rows of its tables, and the numbers of its places."""

    task: Any
    config: Any
    rows: Mapping[str, Sequence[Row]]
    places: Mapping[str, Sequence[float]]


def sketch(name: str) -> Sketch:
    """The task of this name with its default configuration."""
    kind = find_task(name)
    config: Any = kind.config_type()
    task: Any = kind.sketch(config)
    return Sketch(task, config, tables(task.plan), numbers(task.plan))


def page() -> str:
    """The page, in Markdown."""
    parts = [HEAD]
    for family, names in FAMILIES.items():
        found = {name: sketch(name) for name in names}
        parts.append(f"## {family}\n\n{_preview(found)}")
        for section in ("observations", "observations of critic"):
            keys = ("name", "term", "numbers", "scale", "noise", "clip", "delay", "history")
            parts.append(_section(section, "columns of each", found, keys, lambda row: row["columns"]))
        parts.append(_section("actions", "scales", found, ("name", "term", "numbers"), lambda row: row["scale"]))
        parts.append(
            _section("rewards", "weights", found, ("name", "term", "numbers", "per"), lambda row: row["weight"])
        )
        parts.append(_section("terminations", "", found, ("name", "term", "numbers", "counts as"), _admitted))
        parts.append(_section("commands", "how long each holds", found, ("name", "term"), lambda row: row["every"]))
        parts.append(_commands(found))
        parts.append(_section("events", "pushes among them", found, ("name", "term", "numbers", "when"), _admitted))
        parts.append(_section("randomize", "once for each world", found, ("name", "of"), _admitted))
        parts.append(_section("curricula", "", found, ("name", "term", "numbers"), _admitted))
    return "\n".join(part for part in parts if part)


def _admitted(row: Row) -> str:
    return "yes"


def _preview(found: Mapping[str, Sketch]) -> str:
    """The settings of each task that are one number or word."""
    rows = {name: _values(name, sketched) for name, sketched in found.items()}
    labels = next(iter(rows.values()))
    return _table(["", *rows], [[label, *(values[label] for values in rows.values())] for label in labels])


def _values(name: str, sketched: Sketch) -> dict[str, str]:
    task, config = sketched.task, sketched.config
    options, theirs, ppo = task.solver_options, MJLAB[name], config.ppo
    delays = [int(row["delay"].rpartition(" ")[2]) for row in sketched.rows["observations"] if row["delay"]]
    critic = sum(int(row["columns"]) for row in sketched.rows.get("observations of critic", ()))
    return {
        "physics step [ms]": f"{1000.0 / (config.control_hz * config.substeps):g}",
        "physics steps a control step": str(config.substeps),
        "episode [s]": f"{config.episode_seconds:g}",
        "integrator": options["integrator"],
        "friction cone, `impratio`": f"{options['cone']}, {options['impratio']:g}",
        "solver iterations, of the line search": f"{options['iterations']}, {options['ls_iterations']}",
        "iterations in mjlab": f"{theirs['iterations']}, {theirs['ls_iterations']}",
        "contacts, rows of constraints of a world": f"{options['nconmax']}, {options['njmax']}",
        "contacts, rows in mjlab": f"{theirs['nconmax'] or 'chosen'}, {theirs['njmax']}",
        "observations of policy, critic": f"{len(task.observation_names)}, {critic or len(task.observation_names)}",
        "delay of observations, actions [control steps]": f"{max(delays, default=0)}, {config.randomize.action_latency}",
        "actions": str(len(task.action_names)),
        "weights by iteration": ", ".join(f"`{term}` {_points(points)}" for term, points in config.curriculum.items()),
        "hidden layers, activation": f"{', '.join(map(str, ppo.hidden_sizes))}, {ppo.activation}",
        "steps, epochs, minibatches": f"{ppo.steps}, {ppo.epochs}, {ppo.minibatches}",
        "learning rate, desired KL": f"{ppo.learning_rate:g}, {ppo.desired_kl:g}",
        "entropy, discount, lambda": f"{ppo.entropy_coef:g}, {ppo.gamma:g}, {ppo.lam:g}",
    }


def _section(
    section: str, note: str, found: Mapping[str, Sketch], keys: Sequence[str], value: Callable[[Row], str]
) -> str:
    """One row for each term, shared by the tasks in which it is the same; empty columns are left out."""
    cells: dict[tuple[str, ...], dict[str, str]] = {}
    for name, sketched in found.items():
        for row in sketched.rows.get(section, ()):
            cells.setdefault(tuple(row.get(key, "") for key in keys), {})[name] = value(row)
    if not cells:
        return ""
    kept = [index for index in range(len(keys)) if any(row[index] for row in cells)]
    firsts = [row[0] for row in cells]
    rows = [
        [*(_cell(keys[index], row[index]) for index in kept), *(cells[row].get(name, "") for name in found)]
        for row in sorted(cells, key=lambda row: firsts.index(row[0]))  # group equal names
    ]
    title = section.capitalize() + (f": {note}" if note else "")
    return f"### {title}\n\n" + _table([*(keys[index] for index in kept), *found], rows)


def _commands(found: Mapping[str, Sketch]) -> str:
    """The ranges of commands at the start of training, and their stages by iteration, if any."""
    cells: dict[str, dict[str, str]] = {}
    for name, sketched in found.items():
        for place, values in sketched.places.items():
            if place.startswith("commands.") and not place.endswith(".seconds"):
                text = ", ".join(f"{value:g}" for value in values)
                cells.setdefault(place, {})[name] = f"[{text}]" if len(values) > 1 else text
        for stages in ("command_forward", "command_left", "command_turn"):
            if hasattr(sketched.config, stages):
                cells.setdefault(f"config.{stages}", {})[name] = _points(getattr(sketched.config, stages))
    rows = [[f"`{place}`", *(values.get(name, "") for name in found)] for place, values in cells.items()]
    return "### Ranges and shares of commands\n\n" + _table(["place", *found], rows)


def _points(points: Sequence[Sequence[float]]) -> str:
    """Pairs of an iteration and the value from there on."""
    return " ".join(f"[{', '.join(f'{number:g}' for number in point)}]" for point in points)


def _cell(key: str, text: str) -> str:
    """Format names and settings as code."""
    if not text:
        return ""
    return f"`{text}`" if key in ("name", "term", "of") else text


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines) + "\n"
