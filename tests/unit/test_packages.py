"""Law 2: orchestrator → shared_store ← worker, and no torch outside the worker."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from orchestrator.cli.catalogue import ENTRIES, load
from tests.conftest import REPOSITORY

HEAVY = {"torch", "warp", "newton", "rsl_rl", "gymnasium", "tensordict", "mujoco"}
FORBIDDEN = {
    "orchestrator": HEAVY | {"worker"},
    "shared_store": HEAVY | {"worker", "orchestrator"},
    "worker": {"orchestrator"},
    "policy_node": HEAVY | {"worker", "orchestrator", "shared_store"},
}
LIGHT_IN_WORKER = (
    "supervisor.py",
    "aws_node.py",
    "lifeline.py",
    "slurm_node.py",
    "rank.py",
    "processes.py",
    "network.py",
    "__init__.py",
)


def imported(path: Path) -> set[str]:
    """Top-level names of everything that the module imports, at any depth of nesting."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.partition(".")[0])
    return names


@pytest.mark.parametrize("package", FORBIDDEN)
def test_no_module_imports_what_its_room_may_not(package: str) -> None:
    modules = list((REPOSITORY / package).rglob("*.py"))
    assert len(modules) > 5
    for module in modules:
        assert not imported(module) & FORBIDDEN[package], module


def test_the_supervisor_imports_no_torch() -> None:
    for name in LIGHT_IN_WORKER:
        assert not imported(REPOSITORY / "worker" / name) & HEAVY, name
    code = "import sys, worker.supervisor, worker.slurm_node, orchestrator.cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not set(loaded) & HEAVY


def test_help_imports_no_command_and_each_says_what_its_own_help_says() -> None:
    code = "import sys; sys.argv = ['muster', '--help']; import orchestrator.cli as c, atexit\natexit.register(lambda: print(*sys.modules)); c.main()"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "orchestrator.cli.catalogue" in loaded
    assert not {"httpx", "pydantic", "sqlalchemy", "yaml", "orchestrator.cli.jobs"} & set(loaded)
    for entry in ENTRIES:
        own = " ".join((load(entry.name).help or "").partition("\n\n")[0].split())
        assert own == entry.summary, entry.name


def test_no_module_is_too_long_to_be_seen_whole() -> None:
    for package in (*FORBIDDEN, "tests", "benchmarks"):
        for module in (REPOSITORY / package).rglob("*.py"):
            assert len(module.read_text().splitlines()) <= 450, module
