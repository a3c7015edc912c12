"""A store with models of racers and a league, as pages show them."""

from __future__ import annotations

from typing import Any

from racer.store import leagues
from shared_store.volume.layout import Store
from shared_store.volume.models import Model
from tests.support.orchestrator.models import add_model
from tests.support.racer.leagues import entry, league, race, summary

TRAIN = {"task": "Racer", "worlds": 4, "iterations": 9}


def add_racer(store: Store, name: str, run: str, iteration: int, queue: str = "default", **facts: Any) -> Model:
    """The next version of a model, of a new checkpoint of a racer's run, which has been raced once."""
    found = summary(race([12.0, 12.5, 13.0]), seed=3, config={})
    return add_model(store, name, run, iteration, queue, train=TRAIN, evaluation=found, **facts)


def add_league(store: Store, name: str = "cup", *racers: str) -> None:
    """A league with an entry of each racer."""
    stored = leagues.create(store, league(name))
    for version, racer in enumerate(racers, 1):
        stored.enter(entry(racer, version=version))
