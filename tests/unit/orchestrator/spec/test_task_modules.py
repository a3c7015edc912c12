"""The module of an installed task: a job is refused where it can't be there, and nothing of it is imported to know that."""

from __future__ import annotations

import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from orchestrator.spec.task_modules import module_problem
from orchestrator.spec.values import task_name

SOURCES = {
    "own_raises/__init__.py": "1 / 0\n",
    "own_raises/task.py": "class Task: pass\n",
    "own_syntax.py": "x = 1\ndef (\n",
    "own_names.py": "from elsewhere import Given as Named\nMade = type('Made', (), {})\nif Made:\n    class Inner: pass\n",
    "own_star.py": "from elsewhere import *\n",
}


@pytest.fixture(autouse=True)
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, source in SOURCES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(source)
    (tmp_path / "own-1.dist-info").mkdir()
    (tmp_path / "own-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: own\nVersion: 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


@pytest.mark.parametrize(
    ("place", "problem"),
    [
        ("nowhere.task:Task", "there is no module nowhere"),
        ("own_raises.other:Task", "there is no module own_raises.other"),
        ("own_names.task:Task", "there is no module own_names.task"),
        ("own_names:Given", "own_names.py has no class Given"),
        ("own_names", "its entry point own_names names no class"),
        ("own_syntax:Task", "own_syntax.py:2: SyntaxError: invalid syntax"),
    ],
)
def test_what_can_t_be_there_is_named(place: str, problem: str) -> None:
    assert (module_problem(place) or "").endswith(problem)


@pytest.mark.parametrize(
    "place", ["own_raises.task:Task", *(f"own_names:{each}" for each in ("Named", "Made", "Inner"))]
)
def test_what_may_be_there_is_let_through_without_an_import(place: str) -> None:
    assert module_problem(place) is None
    assert not {"own_raises", "own_names"} & sys.modules.keys()


@pytest.mark.parametrize("place", ["own_star:Task", "json:JSONDecoder", "time:Task"])
def test_what_only_an_import_can_say_is_let_through(place: str) -> None:
    assert module_problem(place) is None


def test_a_task_of_a_package_that_lost_its_module_is_refused_by_name(path: Path) -> None:
    (path / "own-1.dist-info" / "entry_points.txt").write_text("[muster.tasks]\nLost = own_raises.other:Lost\n")
    words = (
        r"^task Lost can't be imported: there is no module own_raises\.other; install another version of its package$"
    )
    with pytest.raises(ValueError, match=words):
        task_name("Lost")


def test_every_installed_task_is_let_through() -> None:
    for point in entry_points(group="muster.tasks"):
        assert task_name(point.name) == point.name
