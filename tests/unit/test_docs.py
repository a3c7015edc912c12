"""The pages: every link leads to a file and a heading, and every page can be found."""

from __future__ import annotations

import re
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.support.pages import repository_files

PAGES = sorted(REPOSITORY / name for name in repository_files("*.md"))
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
"""Of a page or a picture."""
IMPORT = re.compile(r"^from ((?:orchestrator|racer|shared_store|worker)[\w.]*) import (\([^)]*\)|.+)$", re.MULTILINE)


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ +(.+?) *$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_every_link_of_a_page_leads_to_a_file_and_a_heading(page: Path) -> None:
    for match in LINK.finditer(prose(page)):
        target = match[1]
        if target.startswith(("http://", "https://")):
            continue
        path, _, anchor = target.partition("#")
        existing = (page.parent / path).resolve() if path else page
        assert existing.exists(), f"{target}: there is no such file"
        if anchor:
            assert anchor in anchors(existing), f"{target}: no such heading"


def test_every_page_can_be_reached_from_the_readme() -> None:
    reached, found = set(), [REPOSITORY / "README.md"]
    while found:
        page = found.pop()
        if page in reached:
            continue
        reached.add(page)
        targets = (match[1].partition("#")[0] for match in LINK.finditer(prose(page)))
        found += [
            (page.parent / target).resolve() for target in targets if target.endswith(".md") and "://" not in target
        ]
    assert {page for page in PAGES if page.is_relative_to(REPOSITORY / "docs")} - reached == set()


def test_the_readme_is_short() -> None:
    assert len((REPOSITORY / "README.md").read_text().splitlines()) <= 150


def test_what_the_pages_import_is_there() -> None:
    named = {
        (module, name)
        for page in PAGES
        for module, names in IMPORT.findall(page.read_text())
        for name in re.findall(r"(\w+)(?: as \w+)?", re.sub(r"#.*", "", names))
    }
    assert len(named) > 50
    for module, name in named:
        try:
            found = getattr(import_module(module), name, None)
        except ModuleNotFoundError:
            found = None
        assert found is not None or find_spec(f"{module}.{name}") is not None, f"{module}.{name}"


EXAMPLE = sorted((REPOSITORY / "docs" / "examples" / "notes" / "muster_notes").glob("*.py"))


@pytest.mark.parametrize("module", EXAMPLE, ids=lambda module: module.name)
def test_the_example_of_a_plug_in_imports_what_its_page_allows(module: Path) -> None:
    page = (REPOSITORY / "docs" / "plug-ins.md").read_text()
    allowed = set(re.findall(r"^\| `((?:orchestrator|worker|shared_store)\.[a-z_.]+)` \|", page, re.MULTILINE))
    found = {match[1]: match[2] for match in IMPORT.finditer(module.read_text())}
    assert found.keys() <= allowed
    assert not any(re.search(r"\b_", names) for names in found.values())
    sides = {name.partition(".")[0] for name in found} - {"shared_store"}
    assert len(sides) <= 1, "a rank reads it, or the controller"
