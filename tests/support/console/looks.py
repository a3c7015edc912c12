"""How pages look: read by axe, and on a phone. Each leaves a picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from axe_playwright_python.sync_playwright import Axe

from tests.support.console.person import PHONE, Person

RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]


def assert_no_faults(person: Person, places: Mapping[str, str], scheme: str) -> None:
    """Axe finds no fault on any of these pages; their addresses, by a name."""
    faults = []
    for name, path in places.items():
        page = person.goto(path)
        page.wait_for_load_state("load")
        page.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
        found = Axe().run(page, options={"runOnly": RULES})
        faults += [f"{name}: {_fault_of(each)}" for each in found.response["violations"]]
        person.picture(f"{name}-{scheme}")
    assert not faults, "\n".join(faults)


def _fault_of(violation: dict[str, Any]) -> str:
    first = violation["nodes"][0]
    return f"{violation['id']} ({len(violation['nodes'])}): {first['html'][:200]} {first['failureSummary'][:300]}"


def assert_fit_a_phone(person: Person, places: Mapping[str, str]) -> None:
    """None of these pages is wider than a phone."""
    wide = {}
    for name, path in places.items():
        page = person.goto(path)
        page.wait_for_load_state("load")
        person.picture(f"{name}-phone")
        wide[name] = page.evaluate("document.documentElement.scrollWidth")
    assert {name: width for name, width in wide.items() if width > PHONE["width"]} == {}
