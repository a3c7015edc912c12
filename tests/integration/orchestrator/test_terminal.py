"""What others wrote is printed as text: a name, a reason or a log line can't move the cursor, ring, retitle or turn the line."""

from __future__ import annotations

import io
import json
import logging
import re
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.table import Table

from orchestrator.cli import terminal
from orchestrator.cli.terminal import Console, echo, echo_json, log_visibly, one_line, visible
from tests.conftest import Serving, wait_for

HOSTILE = "\x1b]0;title\x07\x1b[2J\x1b[31mred\x9b1m\u202eevil\r\x7f"
SHOWN = r"\x1b]0;title\x07\x1b[2J\x1b[31mred\x9b1m\u202eevil\r\x7f"


def test_everything_that_a_terminal_acts_on_is_shown_escaped() -> None:
    assert visible(HOSTILE) == SHOWN
    assert visible("a\tb\nc é 日本 👩‍🚀") == "a\tb\nc é 日本 👩‍🚀"
    assert visible("\u2028\u2066\ufeff\ud800\U000e0041\x00") == r"\u2028\u2066\ufeff\ud800\U000e0041\x00"


@given(st.text(st.characters()))
def test_no_text_leaves_a_control_character(text: str) -> None:
    shown = visible(text)
    assert {c for c in shown if unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp")} <= {"\t", "\n"}
    turning = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
    assert not turning & set(map(unicodedata.bidirectional, shown))
    assert visible(shown) == shown
    coloured = visible(text, colours=True)
    assert "\x1b" not in re.sub(r"\x1b\[[0-9;]*m", "", coloured)
    shown.encode()


def test_colours_of_a_log_line_stay_and_end_with_the_line() -> None:
    assert visible("\x1b[1;31mloss\x1b[K 3", colours=True) == "\x1b[1;31mloss\\x1b[K 3\x1b[0m"
    assert visible("plain\x07\x1b[K", colours=True) == "plain\\x07\\x1b[K"


def test_a_reason_with_lines_of_its_own_is_one_line() -> None:
    assert one_line("first\n  attempt 2 succeeded\r\n\x85third\u2028") == "first attempt 2 succeeded third"


def test_a_console_escapes_texts_and_keeps_its_own_colours() -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, color_system="standard", width=100)
    table = Table(box=None)
    table.add_column("REASON")
    table.add_row("\x1b[2Jcleared\u202e")
    console.print(table)
    console.print("[green]done[/] \x9b2J", highlight=False)
    printed = out.getvalue()
    assert "\\x1b[2Jcleared\\u202e" in printed and "\x1b[32mdone\x1b[0m \\x9b2J" in printed
    assert "\x1b[2J" not in printed and "\x9b" not in printed


def test_errors_json_and_the_controllers_warnings_are_text(capsys: pytest.CaptureFixture[str]) -> None:
    echo(f"muster: {HOSTILE}", err=True)
    echo_json({"name": HOSTILE})
    log_visibly()
    assert logging.lastResort is not None
    output = logging.lastResort.format(logging.LogRecord("muster", logging.WARNING, "", 0, "job %s", (HOSTILE,), None))
    printed = capsys.readouterr()
    assert printed.err == f"muster: {SHOWN}\n" and output == f"job {SHOWN}"
    assert json.loads(printed.out) == {"name": HOSTILE} and printed.out.isprintable() is False
    assert set(printed.out) - {"\n"} <= set(map(chr, range(32, 127)))


def test_commands_print_through_the_terminal_only() -> None:
    folder = Path(terminal.__file__).parent
    ways = re.compile(
        r"(?<![\w.])print\(|typer\.echo|click\.echo|sys\.std(out|err)\.write|from rich(\.console)? import.*Console|rprint"
    )
    lines = [(path.name, line) for path in folder.glob("*.py") for line in path.read_text().splitlines()]
    found = [f"{name}: {line}" for name, line in lines if ways.search(line)]
    assert found == [r'terminal.py:     print(f"{text}\n", end="", file=sys.stderr if err else sys.stdout, flush=True)']


def test_no_command_hands_a_jobs_escapes_to_the_terminal(shared_server: Serving) -> None:
    server, text = shared_server, HOSTILE.replace("\r", "")
    job = server.gang(f"import time; print({text!r}, flush=True); time.sleep(600)", name="hostile")
    wait_for(lambda: server.log(job) == [text], 30, "the job's line")
    server.client.batch("TerminateJob", jobId=job, reason=HOSTILE)
    server.wait(job)
    reason = SHOWN.replace(r"\r", " ")
    printed = {command: server.muster(*command).stdout for command in (("list",), ("show", job), ("logs", job))}
    for output in printed.values():
        assert not set(output) & set("\x07\x9b\u202e\r\x7f") and not re.search(r"\x1b(?!\[[0-9;]*m)", output), output
    assert reason in printed["list",] and reason in printed["show", job]
    coloured = visible(text, colours=True)
    assert coloured in printed["logs", job] and "\x1b[31mred" in coloured
    assert text in server.muster("logs", job, "--raw").stdout
    refused = server.muster("show", f"no{HOSTILE}")
    assert refused.returncode != 0 and "\x1b" not in refused.stderr and "Traceback" not in refused.stderr
