"""The checker of words that ``make lint`` runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from docs.tools.plain_words import findings


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("was_told = 1", [(1, "was_told: told")]),
        ("def tell():\n    file.tell()\n", [(1, "tell: tell")]),
        ("a = file.tell()\ntell = a\n", [(2, "tell: tell")]),
        ("x = 'a user was told'", [(1, "told")]),
        ("x = f'a user {x} was told'", [(1, "told")]),
        ("x = 'told'", []),
        ("# somebody\n", [(1, "somebody")]),
        ('"""Two\nlines, and somebody."""', [(2, "somebody")]),
        ("def test_a_user_is_told(): ...", [(1, "told")]),
        ("from hypothesis import given\n\n@given(x)\ndef f(): ...\n", []),
        ("there is no such file", []),
    ],
)
def test_a_private_word_is_found_with_its_line(source: str, found: list[tuple[int, str]]) -> None:
    path = Path("a.md" if source.startswith("there") else "a.py")
    assert [(line, word) for line, word, _ in findings(path, source)] == found
