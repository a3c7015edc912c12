"""What `muster tasks NAME` lists of every task that comes with Muster is complete: each table has a row for each declared term."""

from __future__ import annotations

import dataclasses
import functools
import json
from typing import Any

import pytest

from orchestrator.cli.tasks import NUMBERS
from orchestrator.cli.tasks import terms as section_of
from orchestrator.cli.terminal import Console
from tests.support.worker.robots import needs_mjlab
from worker.tasks import find_task
from worker.tasks.__main__ import describe
from worker.tasks.declare.declaration import Image
from worker.tasks.run.find import BUILT_IN

pytestmark = needs_mjlab
DECLARED = sorted({*BUILT_IN} - {"CartpolePixels"})
"""Its policy sees an image; its terms are Cartpole's."""


@functools.cache
def reported(name: str) -> dict[str, Any]:
    return describe(name, whole=True)


@functools.cache
def plan_of(name: str) -> Any:
    kind = find_task(name)
    return kind.sketch(kind.config_type()).plan


@pytest.mark.parametrize("name", DECLARED)
def test_each_table_has_each_term_number_and_setting_of_the_task_and_nothing_else(name: str) -> None:
    found, plan = reported(name), plan_of(name)
    tables, declared = found["tables"], plan.declaration
    sections = (
        "rewards",
        "metrics",
        "terminations",
        "commands",
        "events",
        "curricula",
        "sensors",
        "randomize",
        "actions",
    )
    expected = {section: list(getattr(declared, section)) for section in sections}
    for group, terms in declared.groups.items():
        assert not isinstance(terms, Image)
        expected["observations" if group == "policy" else f"observations of {group}"] = list(terms)
    expected["curriculum"] = list(plan.config.curriculum)
    apart = ("success", "configuration")
    rows_of = {section: [row["name"] for row in rows] for section, rows in tables.items() if section not in apart}
    assert rows_of == {section: names for section, names in expected.items() if names}
    assert [[*row.values()] for row in tables.get("success", [])] == ([[declared.success]] if declared.success else [])

    columns = sum(int(row["columns"]) for row in tables["observations"])
    assert columns == len(found["observations"]) == len(plan.names)
    assert {row["name"]: float(row["weight"]) for row in tables["rewards"]} == pytest.approx(found["rewards"])
    for place, (first, count) in plan.numbers.places.items():
        assert found["numbers"][place] == plan.numbers.values[first : first + count]

    settings = {row["name"]: json.loads(row["value"]) for row in tables["configuration"]}
    of_training = {"rewards", "randomize", "numbers", "curriculum", "ppo", "sac", "rsl_rl"}
    fields = {item.name for item in dataclasses.fields(plan.config)} - of_training
    assert {path.partition(".")[0] for path in settings} == fields
    assert {path: settings[path] for path in settings if "." not in path} == json.loads(
        json.dumps({field: getattr(plan.config, field) for field in fields & {*settings}})
    )

    console = Console(width=400)
    with console.capture() as captured:
        for section, rows in tables.items():
            console.print(section_of(section, rows).table(rows))
        console.print(NUMBERS.table([*found["numbers"].items()]))
    text = captured.get()
    assert all(row["name"] in text for rows in tables.values() for row in rows if "name" in row)
    assert all(place in text for place in found["numbers"])


def test_changes_during_training_are_listed_by_iteration() -> None:
    points = [[0, -0.01], [499, -0.01], [500, -0.1], [999, -0.1], [1000, -1.0]]
    found = reported("LiftCube")
    assert found["curriculum"] == {"joint_vel_hinge": points}
    text = "0: -0.01, 499: -0.01, 500: -0.1, 999: -0.1, 1000: -1"
    assert found["tables"]["curriculum"] == [{"name": "joint_vel_hinge", "value by iteration": text}]
    walking = {row["name"]: row["value"] for row in reported("G1Flat")["tables"]["configuration"]}
    assert walking["command_turn"] == "[[0, -0.5, 0.5], [5000, -0.7, 0.7]]"
    assert walking["solver_iterations"] == "10" and reported("G1Flat")["curriculum"] == {}


def test_a_setting_of_several_parts_has_a_row_for_each() -> None:
    rows = reported("CartpolePixels")["tables"]["configuration"]
    assert {"name": "camera.width", "value": "64"} in rows
