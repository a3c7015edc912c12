"""Wrong use of the command: one line on standard error that says what is wrong and where to read on, exit code 2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from orchestrator.cli.catalogue import ENTRIES, load
from orchestrator.cli.misuse import CommandGroup
from tests.conftest import call_muster

MISUSE = {
    "evalute": "evalute: there is no such command; did you mean evaluate? (a plug-in's: install its package)",
    "zzz": "zzz: there is no such command; see: muster --help (a plug-in's: install its package)",
    "--verison": "--verison: there is no such option; did you mean --version? see: muster --help",
    "evaluate x --episods 5": (
        "--episods: there is no such option; did you mean --episodes? see: muster evaluate --help"
    ),
    "list -z": "-z: there is no such option; see: muster list --help",
    "models lst": "lst: there is no such command; did you mean list?",
    "models qqq": "qqq: there is no such command; see: muster models --help",
    "models diff a --jsn": "--jsn: there is no such option; did you mean --json? see: muster models diff --help",
    "evaluate": "RUN[@ITERATION|@best|@latest] is missing; see: muster evaluate --help",
    "logs": "JOB is missing; see: muster logs --help",
    "models register x": "--name is missing; see: muster models register --help",
    "queues a b": "b: more arguments than the command takes; see: muster queues --help",
    "evaluate x --episodes ten": "--episodes: expected a whole number, found ten; see: muster evaluate --help",
    "run x --cpus many": "--cpus: expected a number, found many; see: muster run --help",
    "serve --port 70000": (
        "--port: expected a value less than or equal to 65535, found '70000'; see: muster serve --help"
    ),
    "serve --port": "--port needs a value; see: muster serve --help",
    "list --json=5": "--json takes no value; see: muster list --help",
}


@pytest.mark.parametrize("typed", MISUSE)
def test_wrong_use_is_one_line_that_names_the_nearest(tmp_path: Path, typed: str) -> None:
    line = MISUSE[typed]
    done = call_muster(*typed.split(), home=tmp_path, COLUMNS="40")
    assert (done.returncode, done.stdout, done.stderr) == (2, "", f"muster: {line}\n")


def test_user_input_reaches_the_terminal_as_text(tmp_path: Path) -> None:
    done = call_muster("list", "--\x1b[2J\nmuster: all is well", home=tmp_path)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "\x1b" not in done.stderr


@pytest.mark.parametrize("typed", ["", "models", "webhooks"])
def test_a_group_without_a_command_shows_its_help_alone(tmp_path: Path, typed: str) -> None:
    done = call_muster(*typed.split(), home=tmp_path)
    assert done.returncode == 2 and "Usage: muster" in done.stdout and done.stderr == ""


def groups() -> list[tuple[str, Any]]:
    found = [(entry.name, load(entry.name)) for entry in ENTRIES]
    return [(name, command) for name, command in found if hasattr(command, "commands")]


def test_every_group_refuses_unknown_commands_alike_and_every_command_has_an_example_and_a_summary() -> None:
    assert {name for name, _ in groups()} >= {"models", "keys", "webhooks", "aws"}
    assert [name for name, command in groups() if not isinstance(command, CommandGroup)] == []
    every = [(entry.name, load(entry.name)) for entry in ENTRIES]
    every += [(f"{name} {own}", each) for name, group in groups() for own, each in group.commands.items()]
    without = [name for name, command in every if "xample" not in (command.epilog or "") or not command.help]
    assert without == []
    assert [entry.name for entry in ENTRIES if len(entry.summary) > 100] == []
    ragged = [name for name, command in every if any("\n" in part for part in command.help.split("\n\n"))]
    assert ragged == [], "the terminal breaks the lines"
