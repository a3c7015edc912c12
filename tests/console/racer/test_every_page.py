"""Every page of the racer: read by axe, dark and light, and on a phone."""

from __future__ import annotations

from typing import Any

import pytest

from shared_store.volume.layout import Store
from tests.support.console.fixtures import Console
from tests.support.console.looks import assert_fit_a_phone, assert_no_faults
from tests.support.console.person import PHONE, People
from tests.support.racer.racers import add_league, add_racer

PLACES = {
    **{"leagues": "/leagues", "league": "/leagues/cup", "entry": "/leagues/cup/entries/1"},
    **{"tracks": "/tracks", "track": "/tracks/oval", "racer": "/models/fast", "racer-wizard": "/submit/task/Racer"},
}


@pytest.fixture(scope="module", autouse=True)
def racers(console: Console) -> None:
    store = Store(console.server.home / "store")
    add_racer(store, "fast", "fast-run", 8)
    add_league(store, "cup", "ada", "grace")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_fault_on_any_page(console: Console, people: People, scheme: Any) -> None:
    assert_no_faults(people(console.url, console.secrets["admin"], color_scheme=scheme), PLACES, scheme)


def test_no_page_is_wider_than_a_phone(console: Console, people: People) -> None:
    person = people(console.url, console.secrets["admin"], viewport=PHONE, has_touch=True, is_mobile=True)
    assert_fit_a_phone(person, PLACES)
