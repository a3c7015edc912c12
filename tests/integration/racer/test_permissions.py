"""Who may do what with tracks and leagues, through a real server: every operation, every kind of key."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest

from racer.plugin import PLUGIN
from racer.store import leagues
from shared_store.volume.layout import Store
from tests.support.conformance.permissions_world import (
    NAMED_WRITE,
    OWN_MADE,
    OWN_WRITE,
    SHARED_READ,
    SHARED_WRITE,
    World,
    answers_as,
)
from tests.support.racer.leagues import entry

LEAGUES, TRACKS = "/api/leagues", "/api/tracks"
LEAGUE = f"{LEAGUES}/{{name}}"
ENTRY = f"{LEAGUE}/entries/{{number}}"
TABLE = {
    f"GET {LEAGUES}": SHARED_READ,
    f"POST {LEAGUES}": OWN_MADE,
    f"GET {LEAGUE}": SHARED_READ,
    f"GET {LEAGUE}/entries": SHARED_READ,
    f"GET {ENTRY}": SHARED_READ,
    f"POST {LEAGUE}/races": NAMED_WRITE,
    f"POST {ENTRY}/races": OWN_WRITE,
    f"POST {LEAGUE}/entries": NAMED_WRITE,
    f"POST {ENTRY}/disqualify": OWN_WRITE,
    f"GET {TRACKS}": SHARED_READ,
    f"POST {TRACKS}": SHARED_WRITE,
}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """With a league of the run's name that has an entry of the model, both of the key ``robots``."""
    world = World(tmp_path_factory.mktemp("home"))
    with world.server:
        world.clients["robots"].post(LEAGUES, {"name": world.run, "track": ["oval"]})
        cup = leagues.find(Store(world.server.home / "store"), world.run)
        model = {"name": world.run, "version": 1, "digest": "0" * 64, "task": "Racer"}
        cup.enter(entry("robots", "key robots", model=model))
        yield world
        for each in (*world.clients.values(), world.http):
            each.close()


def request_of(world: World, operation: str) -> Callable[[str], httpx.Response]:
    """The operation on what the key ``robots`` made in the queue ``robots`` (or on what all share), as a key."""
    bodies: dict[str, Callable[[], dict[str, Any]]] = {
        f"POST {LEAGUES}": lambda: {"name": world.fresh(), "track": ["oval"]},
        f"POST {LEAGUE}/races": lambda: {"model": world.run},
        f"POST {ENTRY}/races": dict,
        f"POST {LEAGUE}/entries": lambda: {"model": world.run, "job": world.job},
        f"POST {ENTRY}/disqualify": lambda: {"reason": "x"},
        f"POST {TRACKS}": lambda: {"name": world.fresh(), "seed": 7},
    }
    body = bodies.get(operation, lambda: None)
    return lambda key: world.native_call(key, operation, body())


@pytest.mark.parametrize("operation", TABLE)
def test_an_operation_is_allowed_or_refused_as_the_table_says(world: World, operation: str) -> None:
    answers_as(TABLE[operation], world, operation, request_of(world, operation), operation.startswith("GET "))


def test_every_operation_of_the_api_stands_in_the_table() -> None:
    assert set(TABLE) == {operation for operation in PLUGIN.operations if "/api/" in operation}
