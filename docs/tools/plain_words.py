"""Find private words in names and messages; ``make lint`` runs it.

    python -m docs.tools.plain_words [FILE…]

Names are the parts of identifiers that Python code defines or uses (``told`` in ``was_told``). Messages are its strings, docstrings and
comments, the texts of the console's pages, and the documentation. Each finding is one line: file, line, the word, the field's word.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

NAMES = {
    "told": "response, report, status, config",
    "said": "message, output, reported",
    "given": "request, input, argument, options",
    "wanted": "requested, filter, target",
    "whose": "owner",
    "asked": "requested, pending",
    "there": "available, existing, present",
    "tell": "report, send",
    "telling": "report",
    "begun": "started",
    "away": "unavailable, absent",
    "glance": "preview, summary",
    "thing": "value, item",
    "things": "values, items",
    "heard": "received, last_seen",
    "somebody": "user, owner",
    "looked": "polled, read",
    "deaf": "unresponsive, cut_off",
    "deafness": "unresponsive, cut_off",
    "barren": "empty, skipped",
    "mishap": "incident, failure",
    "mishaps": "incidents, failures",
}
"""Parts of identifiers, and the field's words for what they mean."""
PHRASES = {
    r"\btold\b": "reported, passed, sent",
    r"\bsaid\b": "reported",
    r"\bsomebody\b": "a user, someone",
    r"\bof one's own\b": "your own, custom",
    r"(?<!there )\b(?:is|are|was|were) no (?!longer\b|more\b|way\b|better\b|worse\b|sooner\b|earlier\b|later\b|greater\b|smaller\b|part\b)[a-z]": "is not a, are not",
    r"\bsigns? of life\b": "heartbeat",
    r"\bcan not\b(?! run Jobs)": "can't, cannot",
    r"\bthat there (?:is|are|was|were)\b": "available, existing",
    r"\bwhat there (?:is|are|was|were)\b": "what exists",
    r"\bout of sight\b": "no permission to see",
    r"\bin trouble\b": "unhealthy",
    r"\b(?:deaf(?:ness)?|barren)\b": "unresponsive, empty",
    r"\bmishaps?\b": "an incident, a failure",
    r"\bnot heard\b": "unknown, no heartbeat",
    r"\b(?:expected|holds|is|be) a text\b": "a string",
    r"\bby themselves alone\b": "alone",
}
"""Regular expressions of messages, and plain words for them."""
PUBLIC = frozenset({"wanted_joint_position", "wanted_joint_velocity", "wanted_anchor_position", "wanted_anchor_turn"})
"""Names of terms that users' tasks have."""

_TEXTS = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}
"""Python 3.12 has tokens of their own for the parts of an f-string."""
_PARTS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_PHRASE = re.compile("|".join(f"(?P<p{number}>{phrase})" for number, phrase in enumerate(PHRASES)), re.IGNORECASE)


def in_names(name: str) -> Iterator[tuple[str, str]]:
    """The private words among the parts of an identifier, each with the field's words."""
    for part in () if name in PUBLIC else _PARTS.findall(name):
        if part.lower() in NAMES:
            yield part.lower(), NAMES[part.lower()]


def in_text(text: str) -> Iterator[tuple[int, str, str]]:
    """Line from 0, private phrase, plain words, for each in a text; a phrase may go on in the next line."""
    for match in _PHRASE.finditer(re.sub(r"\s", " ", text)):
        yield (
            text.count("\n", 0, match.start()),
            match.group(),
            list(PHRASES.values())[int((match.lastgroup or "")[1:])],
        )


def findings(path: Path, source: str) -> Iterator[tuple[int, str, str]]:
    """Line, word and plain words of each finding in a file."""
    if path.suffix != ".py":
        yield from ((line + 1, *rest) for line, *rest in in_text(source))  # type: ignore[misc]
        return
    of_hypothesis: set[str] = set()
    before = ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        line, text = token.start[0], token.string
        if token.type == tokenize.NAME:
            if token.line.startswith("from hypothesis"):
                of_hypothesis.add(text)
            if text.startswith("test_"):  # a sentence
                yield from ((line, *rest) for _, *rest in in_text(text.replace("_", " ")))  # type: ignore[misc]
            elif text not in of_hypothesis and not (text == "tell" and before == "."):  # a file's
                yield from ((line, f"{text}: {word}", plain) for word, plain in in_names(text))
        elif token.type in _TEXTS and (token.type != tokenize.STRING or " " in text):  # a string of one word is a key
            yield from ((line + each, word, plain) for each, word, plain in in_text(text))
        before = text


def files(arguments: list[str]) -> Iterator[Path]:
    """The files to read: those that git tracks, without CHANGELOG and test data."""
    listed = subprocess.run(["git", "ls-files", "-z", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    for name in filter(None, listed.stdout.split("\0")):
        path = ROOT / name
        if path.suffix in {".py", ".md", ".html", ".js"} and not name.startswith(
            (
                "tests/data/",
                "CHANGELOG",
                "docs/tools/plain_words",
                "docs/tools/older_schemas/",
                "tests/unit/test_plain_words",
            )
        ):
            yield path


def main() -> int:
    """Print the findings; the exit status is 1 if there are any."""
    count = 0
    for path in files(sys.argv[1:]):
        for line, word, plain in findings(path, path.read_text()):
            print(f"{path.relative_to(ROOT)}:{line}: {word!r}: write {plain}")
            count += 1
    if count:
        print(f"{count} private words", file=sys.stderr)
    return 1 if count else 0


if __name__ == "__main__":
    sys.exit(main())
