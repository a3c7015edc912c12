"""Law 2: orchestrator → shared_store ← worker, and no torch outside the worker."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from orchestrator.cli.catalogue import ENTRIES, load
from tests.conftest import REPOSITORY, wait_for

HEAVY = {"torch", "warp", "newton", "rsl_rl", "gymnasium", "tensordict", "mujoco"}
FORBIDDEN = {
    "orchestrator": HEAVY | {"worker"},
    "shared_store": HEAVY | {"worker", "orchestrator"},
    "worker": {"orchestrator"},
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


def test_a_bare_installation_gives_a_working_controller_without_torch(tmp_path: Path) -> None:
    venv.create(tmp_path / "bare", with_pip=True)
    python = str(tmp_path / "bare" / "bin" / "python")
    install = [python, "-m", "pip", "install", "-q", "-c", str(REPOSITORY / "constraints.txt"), str(REPOSITORY)]
    subprocess.run(install, check=True, capture_output=True, timeout=300)
    missing = (
        "import importlib.util, sys; sys.exit(any(importlib.util.find_spec(m) for m in ('torch', 'warp', 'newton')))"
    )
    subprocess.run([python, "-c", missing], check=True)
    spec = tmp_path / "job.yaml"
    spec.write_text(
        "name: bare\nnodes: 2\nresources: {cpus: 0.1, memory: 16MiB}\ncommand: [python, -c, 'print(6 * 7)']\n"
    )
    env = {**os.environ, "MUSTER_HOME": str(tmp_path / "home")}
    done = subprocess.run(
        [str(tmp_path / "bare" / "bin" / "muster"), "run", str(spec)],
        env=env,
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "42" in done.stdout, done.stdout + done.stderr
    wait_for(lambda: not (tmp_path / "home" / "controller.json").exists(), 5, "the embedded controller's end")


def test_no_module_is_too_long_to_be_seen_whole() -> None:
    for package in (*FORBIDDEN, "tests", "benchmarks"):
        for module in (REPOSITORY / package).rglob("*.py"):
            assert len(module.read_text().splitlines()) <= 450, module
