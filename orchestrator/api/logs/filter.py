"""Filter patterns of CloudWatch Logs for plain text: ``term "a phrase" -not ?either ?or %regex%``.

Regular expressions are AWS's subset (no groups), which is matched by an automaton built as it is needed: its time grows with the
length of the line alone, where Python's ``re`` can be made to stop the whole server by one unlucky pattern. ``re`` is used for
single characters only.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

Matcher = Callable[[str], bool]

_TERM = re.compile(r'\s*([-?]?)(?:"((?:[^"\\]|\\.)*)"|%((?:[^%\\]|\\.)+)%|([^\s"%]\S*))(?=\s|$)', re.DOTALL)
_ATOM = re.compile(
    r"(\\[dDsSwW]|\\[^A-Za-z0-9]|\[\^?\]?(?:[^\]\\]|\\.)*\]|[^\\\[\](){}*+?|^$])([*+?]|\{\d{1,3}(?:,\d{0,3})?\})?"
)
_MOST_REGEXES = 2
_MOST_ATOMS = 500
"""Atoms of one regex after repeats are written out: what a step of the automaton may cost."""
_MOST_STEPS = 20_000
"""Steps that the automaton remembers."""


def parse(pattern: str) -> Matcher:
    """Whether a line matches: every plain term, one of the ``?`` terms if there are any, and none of the ``-`` terms.

    Raises:
        ValueError: The pattern can't be read, or is of a kind that is for JSON or for fields.
    """
    if pattern.lstrip()[:1] in ("{", "["):
        raise ValueError('patterns for JSON {…} and for fields […] are not supported; use terms, "phrases" and %regex%')
    terms: dict[str, list[Matcher]] = {"": [], "-": [], "?": []}
    regexes = position = 0
    while pattern[position:].strip():
        match = _TERM.match(pattern, position)
        if not match:
            raise ValueError(f"can't be read from {pattern[position:].strip()[:40]!r} on: a quote or % has no partner")
        sign, phrase, regex, word = match.groups()
        regexes += regex is not None
        if regexes > _MOST_REGEXES:
            raise ValueError(f"has more than {_MOST_REGEXES} regular expressions")
        plain = re.sub(r"\\(.)", r"\1", phrase, flags=re.DOTALL) if phrase is not None else word
        terms[sign].append(_Automaton.of(regex).search if regex is not None else _contains(plain))
        position = match.end()
    wanted, unwanted, either = terms[""], terms["-"], terms["?"]

    def matches(line: str) -> bool:
        return (
            all(term(line) for term in wanted)
            and not any(term(line) for term in unwanted)
            and (not either or any(term(line) for term in either))
        )

    return matches


def _contains(text: str) -> Matcher:
    return lambda line: text in line


@dataclass(frozen=True)
class _Atom:
    """One place of a regex: the characters that it takes, and whether it may be passed over or taken again."""

    takes: re.Pattern[str]
    optional: bool = False
    again: bool = False


@dataclass
class _Automaton:
    """A regex as a set of places, one bit each; a place without an atom is the end of a branch."""

    places: list[_Atom | None] = field(default_factory=list)
    anchored: int = 0
    """Places at which a branch with ``^`` begins."""
    floating: int = 0
    """Places at which a branch begins anywhere in the line."""
    found: int = 0
    """Ends that are reached anywhere in the line."""
    found_at_end: int = 0
    """Ends that count at the end of the line (``$``)."""
    steps: dict[int, dict[str, int]] = field(default_factory=dict)
    remembered: int = 0

    @classmethod
    def of(cls, regex: str) -> _Automaton:
        """Raises ValueError for what AWS's subset does not have."""
        built, position = cls(), 0
        while True:
            begin = 1 << len(built.places)
            if regex[position : position + 1] == "^":
                built.anchored |= begin
                position += 1
            else:
                built.floating |= begin
            while atom := _ATOM.match(regex, position):
                built._add(regex, atom[1], atom[2] or "")
                position = atom.end()
            if regex[position : position + 1] == "$":
                built.found_at_end |= 1 << len(built.places)
                position += 1
            else:
                built.found |= 1 << len(built.places)
            built.places.append(None)
            if position == len(regex):
                return built
            if regex[position] != "|":
                raise ValueError(f"regular expression %{regex}% can't be read from {regex[position:]!r} on")
            position += 1

    def _add(self, regex: str, atom: str, repeat: str) -> None:
        try:
            takes = re.compile(atom, re.DOTALL)
        except re.error as error:
            raise ValueError(f"regular expression %{regex}%: {error}") from None
        low, high = {"": (1, 1), "?": (0, 1), "*": (0, None), "+": (1, None)}.get(repeat) or _bounds(regex, repeat)
        self.places += [_Atom(takes)] * low
        self.places += [_Atom(takes, True, True)] if high is None else [_Atom(takes, True)] * (high - low)
        if len(self.places) > _MOST_ATOMS:
            raise ValueError(f"regular expression %{regex}% is too long")

    def search(self, line: str) -> bool:
        """Whether the regex matches somewhere in the line."""
        if self.remembered > _MOST_STEPS:
            self.steps, self.remembered = {}, 0
        state = self._closure(self.anchored | self.floating)
        for character in line:
            if state & self.found:
                return True
            row = self.steps.setdefault(state, {})
            following = row.get(character)
            if following is None:
                following = row[character] = self._step(state, character)
                self.remembered += 1
            state = following
        return bool(state & (self.found | self.found_at_end))

    def _step(self, state: int, character: str) -> int:
        following = self.floating
        for place, atom in enumerate(self.places):
            if atom and state >> place & 1 and atom.takes.fullmatch(character):
                following |= 1 << (place if atom.again else place + 1)
        return self._closure(following)

    def _closure(self, state: int) -> int:
        for place, atom in enumerate(self.places):
            if atom and atom.optional and state >> place & 1:
                state |= 1 << (place + 1)
        return state


def _bounds(regex: str, repeat: str) -> tuple[int, int | None]:
    low, comma, high = repeat[1:-1].partition(",")
    least, most = int(low), (int(high) if high else None) if comma else int(low)
    if most is not None and most < least:
        raise ValueError(f"regular expression %{regex}%: {repeat} ends before it begins")
    return least, most
