"""Processes that do the same at the same moment."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tests.support.waiting import PATIENCE


def at_once(action: Callable[..., Any], calls: Sequence[tuple[str, ...]]) -> list[Any]:
    """What each call answers (as JSON has it), each in a process of its own; all begin together."""
    name = f"{action.__module__}:{action.__name__}"
    command = [sys.executable, "-m", "tests.support.shared_store.at_once", name, json.dumps(calls)]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[3], check=True, timeout=60 * PATIENCE, stdout=subprocess.PIPE, text=True
    )
    answers = dict(json.loads(line) for line in done.stdout.splitlines())
    return [answers[number] for number in range(len(calls))]


def _main(name: str, calls: list[list[str]]) -> None:
    module, _, function = name.partition(":")
    action = getattr(importlib.import_module(module), function)
    gate, opened = os.pipe()
    children = [_child(action, number, call, gate, opened) for number, call in enumerate(calls)]
    os.close(opened)
    sys.exit(max(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children))


def _child(action: Callable[..., Any], number: int, call: list[str], gate: int, opened: int) -> int:
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.close(opened)
            os.read(gate, 1)  # until the parent, and so every child, has closed its end
            os.write(1, f"{json.dumps([number, action(*call)])}\n".encode())
            code = 0
        finally:
            os._exit(code)
    return child


if __name__ == "__main__":
    _main(sys.argv[1], json.loads(sys.argv[2]))
