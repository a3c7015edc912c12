"""The racer reaches the rest of Muster through public names alone, and nothing of the rest knows the racer."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

OTHERS = ("orchestrator", "worker", "shared_store")
PAGE = (REPOSITORY / "docs" / "plug-ins.md").read_text()
PUBLIC = set(re.findall(rf"^\| `((?:{'|'.join(OTHERS)})\.[a-z_.]+)` \|", PAGE, re.MULTILINE))
"""The modules in the tables of the page."""
WORKER_BY_THE_CONTROLLER = "worker.settings"
HEAVY = {"torch", "warp", "newton"}
OF_RANKS = ("car", "race")
"""Rooms of the racer that ranks import; ``rewards`` has modules for both sides."""
OLD_NAMES = {"worker/__init__.py", "shared_store/__init__.py"}
"""They lead from names that modules of the racer once had to those of today."""


def is_module(name: str) -> bool:
    path = REPOSITORY / name.replace(".", "/")
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def imported(path: Path) -> Iterator[tuple[str, str]]:
    """Module and name of all that a module imports, at any depth of nesting; the name is empty where it is a module itself."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield (full, "") if is_module(full) else (node.module, alias.name)


def modules(package: str) -> list[Path]:
    found = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", f"{package}/*.py"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    return [REPOSITORY / line for line in found.stdout.splitlines() if (REPOSITORY / line).is_file()]


def test_the_page_lists_existing_modules() -> None:
    assert len(PUBLIC) > 50
    assert [name for name in sorted(PUBLIC) if not is_module(name)] == []


@pytest.mark.parametrize("path", modules("racer"), ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_a_module_of_the_racer_imports_public_names_alone(path: Path) -> None:
    for module, name in imported(path):
        if module.partition(".")[0] in OTHERS:
            assert module in PUBLIC, f"{path}: {module} is not public: docs/plug-ins.md"
            assert not name.startswith("_"), f"{path}: {module}.{name} is private"


def test_each_side_of_the_racer_imports_its_own_side_of_muster() -> None:
    for path in modules("racer"):
        room = path.relative_to(REPOSITORY / "racer").parts[0]
        packages = {module.partition(".")[0] for module, _ in imported(path)}
        if room in OF_RANKS or room in ("tracks", "rewards"):
            assert "orchestrator" not in packages, path
        else:
            of_worker = {module for module, _ in imported(path) if module.startswith("worker")}
            assert all(module.startswith(WORKER_BY_THE_CONTROLLER) for module in of_worker), (path, of_worker)
            assert not packages & HEAVY, path


@pytest.mark.parametrize("package", [*OTHERS, "policy_node"])
def test_nothing_else_of_muster_knows_the_racer(package: str) -> None:
    knowing = [
        str(path.relative_to(REPOSITORY))
        for path in modules(package)
        if any(module.partition(".")[0] == "racer" for module, _ in imported(path))
        or re.search(r"\bracer\.[a-z]", path.read_text())
    ]
    assert set(knowing) <= OLD_NAMES, knowing


def test_the_check_of_a_reward_function_imports_neither_torch_nor_warp_nor_numpy() -> None:
    code = "import sys, racer.rewards.__main__; print(*sys.modules)"
    command = [sys.executable, "-c", code]
    loaded = subprocess.run(command, capture_output=True, text=True, check=True, cwd=REPOSITORY).stdout.split()
    assert "racer.rewards.translation.body" in loaded
    assert not {"torch", "warp", "numpy", "newton"} & set(loaded)
