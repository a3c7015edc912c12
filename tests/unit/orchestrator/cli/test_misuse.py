"""Wrong use of the command: one line on standard error that says what is wrong and where to read on, exit code 2. And its help."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from orchestrator.cli.catalogue import ENTRIES, load
from orchestrator.cli.misuse import CommandGroup
from tests.conftest import MUSTER, REPOSITORY, call_muster

PLUGIN = " (if a plug-in provides it, install the plug-in's package)"
MISUSE = {
    "evalute": f"evalute: unknown command; did you mean evaluate?{PLUGIN}",
    "zzz": f"zzz: unknown command; see: muster --help{PLUGIN}",
    "--verison": "--verison: unknown option; did you mean --version? see: muster --help",
    "evaluate x --episods 5": "--episods: unknown option; did you mean --episodes? see: muster evaluate --help",
    "list -z": "-z: unknown option; see: muster list --help",
    "models lst": "lst: unknown command; did you mean list?",
    "models qqq": "qqq: unknown command; see: muster models --help",
    "models diff a --jsn": "--jsn: unknown option; did you mean --json? see: muster models diff --help",
    "evaluate": "RUN[@ITERATION|@best|@latest] is missing; see: muster evaluate --help",
    "logs": "JOB is missing; see: muster logs --help",
    "models register x": "--name is missing; see: muster models register --help",
    "queues a b": "b: more arguments than the command takes; see: muster queues show --help",
    "evaluate x --episodes ten": "--episodes: expected an integer, found ten; see: muster evaluate --help",
    "run x --cpus many": "--cpus: expected a number, found many; see: muster run --help",
    "serve --port 70000": (
        "--port: expected a value less than or equal to 65535, found '70000'; see: muster serve --help"
    ),
    "serve --port": "--port needs a value; see: muster serve --help",
    "list --json=5": "--json takes no value; see: muster list --help",
    "list --status fail": "--status FAIL: unknown status; did you mean FAILED?",
    "--server http://x keys list": "--server: muster keys works on this machine, without a controller; leave --server out",
    "runs --name ant list": "--name: an option of muster runs alone; leave list out",
    "list --server=": "--server: expected the URL of a controller, such as http://127.0.0.1:8080",
    "keys list --server http://x": "--server: unknown option; see: muster keys list --help",
}


@pytest.mark.parametrize("typed", MISUSE)
def test_wrong_use_is_one_line_that_names_the_nearest(tmp_path: Path, typed: str) -> None:
    done = call_muster(*typed.split(), home=tmp_path, COLUMNS="40")
    assert (done.returncode, done.stdout, done.stderr) == (2, "", f"muster: {MISUSE[typed]}\n")


def test_user_input_reaches_the_terminal_as_text(tmp_path: Path) -> None:
    done = call_muster("list", "--\x1b[2J\nmuster: all is well", home=tmp_path)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "\x1b" not in done.stderr


@pytest.mark.parametrize("typed", ["--help", "schema", "run --help"])
def test_a_closed_pipe_ends_a_command_with_0_and_without_a_message(typed: str) -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([MUSTER, *typed.split()], stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("typed", ["", "aws"])
def test_a_group_without_a_command_shows_its_help_alone(tmp_path: Path, typed: str) -> None:
    done = call_muster(*typed.split(), home=tmp_path)
    assert done.returncode == 2 and "Usage: muster" in done.stdout and done.stderr == ""


def test_a_group_without_a_command_lists(tmp_path: Path) -> None:
    assert [
        name for name, group in commands() if "list" in getattr(group, "commands", {}) and group.no_args_is_help
    ] == []
    assert call_muster("keys", home=tmp_path).stdout == call_muster("keys", "list", home=tmp_path).stdout != ""
    made = call_muster("keys", "create", "ada", home=tmp_path, MUSTER_DATABASE=str(tmp_path / "other.db"))
    assert made.returncode == 0, made.stderr


def commands() -> list[tuple[str, Any]]:
    """All commands, and those of groups."""
    every = [(entry.name, load(entry.name)) for entry in ENTRIES]
    return every + [
        (f"{name} {own}", each) for name, group in every for own, each in getattr(group, "commands", {}).items()
    ]


SHARED = ("--json", "--dry-run", "--set", "--server", "--cpus", "--nodes", "--queue", "--overwrite", "--yes", "--store")


def test_every_group_refuses_unknown_commands_alike_and_every_command_has_an_example_and_a_summary() -> None:
    groups = {name: command for name, command in commands() if hasattr(command, "commands")}
    assert groups.keys() >= {"models", "keys", "webhooks", "aws", "runs", "queues"}
    assert [name for name, command in groups.items() if not isinstance(command, CommandGroup)] == []
    without = [name for name, command in commands() if "xample" not in (command.epilog or "") or not command.help]
    assert without == []
    assert [entry.name for entry in ENTRIES if len(entry.summary) > 100] == []


def test_an_option_has_one_spelling_and_one_form_in_all_commands_and_help_is_a_whole_phrase() -> None:
    forms: dict[str, set[tuple[str, ...]]] = {}
    own = [(name, command) for name, command in commands() if name.split()[0] not in ("tracks", "league")]
    for name, command in own:
        for param in command.params:
            if param.param_type_name == "option" and param.opts[0] in SHARED:
                forms.setdefault(param.opts[0], set()).add((*param.opts, *param.secondary_opts, param.metavar))
            assert param.hidden or param.help[0].isupper() or param.help.startswith("postgresql"), (name, param.opts)
    assert {option: len(found) for option, found in forms.items()} == dict.fromkeys(SHARED, 1)
    lacking = {name for name, command in own if "--json" not in str([each.opts for each in command.params])}
    (listed,) = re.findall("All commands take `--json` but (.*), which", (REPOSITORY / "docs/jobs.md").read_text())
    assert lacking == {*re.findall("`(.*?)`", listed)} | {"aws"}, "the group has no options"
    first = {name: command.params[0].metavar for name, command in own if command.params}
    assert {first[name] for name in ("resume", "clone", "evaluate", "export")} == {"RUN[@ITERATION|@best|@latest]"}


def test_help_shows_flags_without_a_value_and_where_the_controller_is_named(tmp_path: Path) -> None:
    shown = call_muster("resume", "--help", home=tmp_path).stdout
    assert (
        "-f, --follow / --no-follow  " in shown
        and "--set KEY=VALUE " in shown
        and "--server URL " in shown
        and "<" not in shown
    )
    root = call_muster("--help", home=tmp_path).stdout
    assert all(part in root for part in ("--server URL", "$MUSTER_URL", "$MUSTER_TOKEN", "muster --install-completion"))


@pytest.mark.parametrize(
    "arguments", [("--server", "http://127.0.0.1:9", "list"), ("list", "--server", "http://127.0.0.1:9")]
)
def test_the_server_is_named_before_or_after_the_command(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    done = call_muster(*arguments, home=tmp_path)
    assert done.returncode == 1 and "no controller answers at http://127.0.0.1:9" in done.stderr
    assert "MUSTER_URL" not in os.environ


def test_the_shell_completes_commands_and_options(tmp_path: Path) -> None:
    def complete(words: str) -> str:
        env = {**os.environ, "MUSTER_HOME": str(tmp_path), "_MUSTER_COMPLETE": "complete_bash", "COMP_WORDS": words}
        env["COMP_CWORD"] = str(len(words.split()) - 1)
        return subprocess.run([MUSTER], env=env, capture_output=True, text=True, check=False).stdout

    assert "resume" in complete("muster re").split() and "--dry-run" in complete("muster resume --dr").split()


def test_help_costs_little_of_the_processor() -> None:
    """The limit is thrice what it costs on a quiet machine beside a start of Python."""
    code = "import sys, time\nfrom orchestrator.cli import main\nsys.argv = ['muster', '--help']\ntry:\n    main()\nexcept SystemExit:\n    pass\nprint(time.process_time(), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stderr) < 0.45 and not re.search(r"Traceback", done.stderr)
