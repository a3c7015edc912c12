"""A name has one meaning: no two modules and no two public classes share one, unless both mean the same thing."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

PACKAGES = ("orchestrator", "shared_store", "worker", "racer")
NAMELESS = {"__init__", "__main__"}

MODULES = {
    "a use case and its adapters: routes, commands, pages": """
        compute_environments curves evaluations export fit jobs keys leagues logs models operations plugins queues
        references retention robot runs submission texts webhooks""",
    "the settings of a thing, and the thing": "actions camera cartpole lift quadruped running sac task velocity",
    "a robot, and the task for it": "g1 go1",
    "the same part of several engines, or an engine's view of what the domain and the contract define": """
        engine gang gangs node""",
    "a contract, and those who keep it": "algorithm bus policy",
    "values, and what makes or shows them": "job snapshot",
    "the same kind of thing in separate rooms": "episodes errors networks picture progress reasons requests",
    "the name by which engines start it, and the program": "supervisor",
    "what comes from another library: its robots, and its names of terms": "mjlab",
    "terms that shipped tasks use, and the others of the same group": """
        bodies commands contacts episode events ground joints locomotion manipulation root sensing""",
}
"""Names of several modules: by what makes their meaning one."""

CLASSES = {
    "what a task declares, and the part of the policy contract that follows from it": "Action Image Term",
    "an observation that a task declares, and each of its numbers for a robot; both names are documented": "Observation",
    "a row of the database, and the same thing for those who use no database": "ComputeEnvironment Job Node",
    "a gang, for its engine and for its ranks": "Gang",
    "a section of the job YAML, and what is made of it": "MLflow Resources WandB",
    "the line on a terminal that says what goes on, of a command and of a rank": "Activity",
    "the operator's command in a task and in the policy contract; a plug-in's in `muster --help`: both names are documented": "Command",
}
"""Names of several public classes, likewise."""


def files() -> list[Path]:
    """Without what pip has copied into ``racer/build``."""
    found = [path for package in PACKAGES for path in sorted((REPOSITORY / package).rglob("*.py"))]
    return [path for path in found if not {"migrations", "build"} & {*path.relative_to(REPOSITORY).parts}]


def classes(path: Path) -> list[str]:
    body = ast.parse(path.read_text()).body
    return [node.name for node in body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]


def shared(names: Iterable[str]) -> set[str]:
    return {name for name, count in Counter(names).items() if count > 1}


def listed(reasons: Mapping[str, str]) -> list[str]:
    return [name for names in reasons.values() for name in names.split()]


MODULE_NAMES = [path.stem for path in files() if path.stem not in NAMELESS]
CLASS_NAMES = [name for path in files() for name in classes(path)]


@pytest.mark.parametrize(
    ("names", "reasons"), [(MODULE_NAMES, MODULES), (CLASS_NAMES, CLASSES)], ids=["modules", "classes"]
)
def test_a_name_of_two_has_one_meaning(names: list[str], reasons: Mapping[str, str]) -> None:
    assert len(names) > 500
    assert not shared(names) - {*listed(reasons)}, "rename one of each pair, or list the name with the reason"


@pytest.mark.skipif(not (REPOSITORY / "racer").is_dir(), reason="some names are shared with the racer")
@pytest.mark.parametrize(
    ("names", "reasons"), [(MODULE_NAMES, MODULES), (CLASS_NAMES, CLASSES)], ids=["modules", "classes"]
)
def test_every_listed_name_is_shared_and_is_listed_once(names: list[str], reasons: Mapping[str, str]) -> None:
    assert sorted(listed(reasons)) == sorted(shared(names))
