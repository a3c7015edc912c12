"""A module's name says what its first line says: they share their noun, so that a reader finds a module from either."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

PACKAGES = ("orchestrator", "shared_store", "worker", "policy_node/muster_policy", "racer")
NAMELESS = {"__init__", "__main__"}
STEM = 4
"""Letters that two forms of a word share: copy and copies, evaluate and evaluation."""


def modules() -> list[Path]:
    """Without what pip has copied into ``racer/build``."""
    found = [path for package in PACKAGES for path in sorted((REPOSITORY / package).rglob("*.py"))]
    apart = {"migrations", "build"}
    return [path for path in found if path.stem not in NAMELESS and not apart & {*path.relative_to(REPOSITORY).parts}]


def first_line(path: Path) -> str:
    return (ast.get_docstring(ast.parse(path.read_text())) or "").partition("\n")[0]


def stems(text: str) -> set[str]:
    return {word[:STEM].lower() for word in re.findall(r"[A-Za-z0-9]+", text)}


@pytest.mark.parametrize("package", PACKAGES)
def test_the_noun_of_a_modules_name_stands_in_its_first_line(package: str) -> None:
    unlike = {}
    for path in modules():
        if path.is_relative_to(REPOSITORY / package):
            noun = path.stem.rpartition("_")[2]
            if noun[:STEM].lower() not in stems(first_line(path)):
                unlike[str(path.relative_to(REPOSITORY))] = first_line(path)
    assert not unlike, "\n".join(f"{name}: {line}" for name, line in unlike.items())
