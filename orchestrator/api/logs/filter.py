"""Filter patterns of CloudWatch Logs for plain text: ``term "a phrase" -not ?either ?or %regex%``.

Regular expressions are AWS's subset (no groups), checked here and matched by RE2. Its time grows with the length of the line alone, where
Python's ``re`` can be made to stop the whole server by one unlucky pattern.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import re2

Matcher = Callable[[str], bool]

_TERM = re.compile(r'\s*([-?]?)(?:"((?:[^"\\]|\\.)*)"|%((?:[^%\\]|\\.)+)%|([^\s"%]\S*))(?=\s|$)', re.DOTALL)
_ESCAPE = r"\\(?:[dDsSwW]|[^A-Za-z0-9])"
_ATOM = (
    rf"(?:{_ESCAPE}|\[\^?\]?(?:[^\]\\]|{_ESCAPE})*+\]|[^\\\[\](){{}}*+?|^$])(?:[*+?]|\{{\d{{1,3}}(?:,\d{{0,3}})?\}})?"
)
_BRANCH = rf"\^?(?:{_ATOM})*+\$?"
_REGEX = re.compile(rf"{_BRANCH}(?:\|{_BRANCH})*+", re.DOTALL)
_MOST_REGEXES = 2
_MEMORY = 512 * 1024
"""Bytes that RE2 may use for one regex. They bound the size of its program, hence the cost of one character of a line."""


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
        terms[sign].append(_found_by(regex) if regex is not None else _contains(plain))
        position = match.end()
    required, excluded, either = terms[""], terms["-"], terms["?"]

    def matches(line: str) -> bool:
        return (
            all(term(line) for term in required)
            and not any(term(line) for term in excluded)
            and (not either or any(term(line) for term in either))
        )

    return matches


def _contains(text: str) -> Matcher:
    return lambda line: text in line


def _found_by(regex: str) -> Matcher:
    """Whether the regex matches somewhere in a line. Raises ValueError for syntax outside AWS's subset."""
    understood = _REGEX.match(regex)
    if rest := regex[understood.end() if understood else 0 :]:
        raise ValueError(f"regular expression %{regex}% can't be read from {rest[:40]!r} on")
    options = re2.Options()
    options.max_mem, options.dot_nl, options.log_errors = _MEMORY, True, False
    try:
        compiled = re2.compile(regex.encode(), options)
    except re2.error as error:
        problem = error.args[0].decode(errors="replace")
        raise ValueError(f"regular expression %{regex}%: {problem}") from None
    return lambda line: compiled.search(line.encode()) is not None
