"""Positions and times in a growing log file, and filter patterns: without a server."""

from __future__ import annotations

import random
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orchestrator.api.logs import log_events
from orchestrator.api.logs.filter import parse
from orchestrator.api.logs.log_events import LogFile, LogSnapshot
from shared_store.volume.logs import format_line

LINES = ["ERROR 404 in trainer", "ERROR in loader", "WARN: loss is nan", "iteration 12/300", 'says "hi" at 50%', "",
         "Fehler: größer"]  # fmt: skip


PATTERNS: dict[str, Any] = {
    **{"": range(7), "ERROR": [0, 1], "error": [], "ERR": [0, 1], "ERROR loader": [1], "loader ERROR": [1]},
    **{'"ERROR in"': [1], '"loader ERROR"': [], "ERROR -404": [1], '-ERROR -"loss is" -"" ': [], "?nan ?404": [0, 2]},
    **{'ERROR ?trainer ?"loss is"': [0], r'"\"hi\""': [4], "50%": [4], "größer": [6], r"%\d{3}%": [0, 3]},
    **{r"%iteration \d+/\d+$%": [3], r"%^in%": [], r"%^(ERROR)%": None, r"%^ERROR|nan$%": [0, 1, 2]},
    **{r"%[Ee]rr?or|[^a-z]rr%": [], r"%[A-Z]{5}% -%\d%": [1], r"%lo+s{1,2} .*n%": [2], r"%^$%": [5]},
    r"%x*%": range(7),
}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_filter_patterns(pattern: str) -> None:
    if PATTERNS[pattern] is None:
        with pytest.raises(ValueError):
            parse(pattern)
    else:
        matches = parse(pattern)
        assert [i for i, line in enumerate(LINES) if matches(line)] == list(PATTERNS[pattern])


_ATOMS = ["a", "b", "-", ".", *(rf"\{each}" for each in ".dDwWsS"), "[ab]", "[^a1]", r"[]\]-]", r"[\d_]", "[^-b]"]
_REPEATS = ["", "", "", "*", "+", "?", "{2}", "{1,}", "{0,2}"]
_BRANCHES = st.tuples(
    st.sampled_from(["", "", "^"]),
    st.lists(st.tuples(st.sampled_from(_ATOMS), st.sampled_from(_REPEATS)).map("".join), max_size=4).map("".join),
    st.sampled_from(["", "", "$"]),
).map("".join)


@settings(max_examples=200)
@given(st.lists(_BRANCHES, min_size=1, max_size=3).map("|".join).filter(bool), st.text("ab1-.] _", max_size=8))
def test_a_regex_means_what_it_means_in_python(regex: str, line: str) -> None:
    assert parse(f"%{regex}%")(line) == (re.search(regex, line, re.ASCII | re.DOTALL) is not None)


UNREADABLE = {
    "a**": "can't be read from '*' on",
    "x(?i)": "can't be read from '(?i)' on",
    r"[\pL]": r"can't be read from '[\\pL]' on",
    r"\bword": r"can't be read from '\\bword' on",
    "a$b": "can't be read from 'b' on",
    "[[:alpha:]]": "can't be read from ']' on",
    "a{3,1}": "invalid repetition size: {3,1}",
    "[z-a]": "invalid character class range: z-a",
    ".{999}" * 150: "pattern too large",
}


@pytest.mark.parametrize("regex", UNREADABLE)
def test_a_regex_that_cannot_be_read_is_refused_with_the_reason(regex: str) -> None:
    with pytest.raises(ValueError, match=re.escape(UNREADABLE[regex])) as refused:
        parse(f"%{regex}%")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "regex",
    [
        ".*a*a*a*a*a*a*a*b.*c.*d",  # for which Python's re needs longer than the universe has
        "[ab]*a[ab]{900}c",  # as a deterministic automaton it has 2^900 states
        "^" + "a?" * 400 + "a{400}b",
        "|".join(f"a.{{{i}}}b" for i in range(1, 60)),
    ],
)
def test_no_regex_can_stop_the_server(regex: str) -> None:
    """What would, does not end: that the test ends proves it."""
    matches, dice = parse(f"%{regex}%"), random.Random(3)
    assert not matches("a" * 20_000)
    matches("".join(dice.choice("ab") for _ in range(20_000)))


def test_a_poll_near_the_end_reads_only_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "node-0.log"
    path.write_text("".join(format_line(1e9 + i / 100, 0, "o", f"line {i} {'x' * 80}") for i in range(100_000)))
    file, read = LogFile(path, "s"), []
    genuine = LogSnapshot._read

    def counting(view: LogSnapshot, offset: int, size: int) -> bytes:
        read.append(size)
        return genuine(view, offset, size)

    monkeypatch.setattr(LogSnapshot, "_read", counting)
    view = file.snapshot()
    found = [event.text.split()[1] for event in view.forward(since=int(1e12) + 999_900)]
    assert found == [str(i) for i in range(99_990, 100_000)]
    assert sum(read) < 70_000 < view.end // 100


def test_any_start_and_any_look_give_the_same_events(tmp_path: Path) -> None:
    """Against the plain definition, on a file that grows, with torn lines, long ones and a clock that jumps."""
    dice, path, clock = random.Random(7), tmp_path / "node-0.log", 1e9
    file, written = LogFile(path, "s"), b""
    for _ in range(60):
        for _ in range(dice.randrange(80)):
            clock += dice.choice([0.0, 0.0004, 0.01, 2.0, -1.5 if dice.random() < 0.1 else 0.0])
            text = "t" * dice.choice([0, 3, 50, 200, 40_000 if dice.random() < 0.02 else 7])
            line = format_line(clock, dice.choice([None, 0, 12]), "e", text)
            written += dice.choice([b"torn\n", b"\n", b"\xff\x00 o \n"]) if dice.random() < 0.02 else line.encode()
        path.write_bytes(written + b"2026-01-01T00:00:0")
        file.snapshot()
    view, expected, offset, top = file.snapshot(), [], 0, 0
    for raw in written.splitlines(keepends=True):
        if match := log_events._STAMPS.match(raw):
            top = max(top, log_events.milliseconds(match[1].decode()))
            expected.append((top, offset, offset + len(raw)))
        offset += len(raw)
    assert view.end == len(written) and view.top == top and len(view.marks) > 5
    for _ in range(100):
        since, start = dice.choice(expected)[0] + dice.randrange(-1, 2), dice.randrange(len(written) + 9)
        fresh = view if dice.random() < 0.5 else LogFile(path, "s").snapshot()
        found = [(e.time, e.offset, e.end) for e in fresh.forward(since, start)]
        assert found == [e for e in expected if e[0] >= since and e[1] >= start]
        back = [(e.time, e.offset, e.end) for e in fresh.backward(since, start)]
        assert back == [e for e in expected if e[0] < since and e[1] < start][::-1]
