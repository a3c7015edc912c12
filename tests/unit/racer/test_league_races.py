"""The job of a race in a league."""

from __future__ import annotations

from typing import Any

from racer.control.league_races import race_job
from racer.store.leagues import CAR, Rules
from tests.support.racer.leagues import league

RACER: dict[str, Any] = {
    "name": "racer",
    "queue": "robots",
    "environment": {"LEVEL": "1"},
    "nodes": 2,
    "resources": {"cpus": 2, "gpus": 4, "memory": 2048},
    "train": {"task": "Racer", "worlds": 8, "iterations": 9},
}
FACTS = {"run": "racer-1", "iteration": 9, "spec": RACER}


def test_a_race_is_driven_by_the_league_s_rules_on_one_node_like_those_of_the_training() -> None:
    rules = Rules(laps=5, continuous=True, off_track_penalty=2.0, max_resets=4, seconds=60.0, ranking="best")
    spec = race_job(league("grand.prix", track=("oval", "hills"), rules=rules), "fast@3", FACTS, "lab")
    assert (spec.name, spec.kind, spec.queue, spec.nodes.max) == ("race-grand-prix-fast-3", "race", "lab", 1)
    assert (spec.resources.cpus, spec.resources.gpus, spec.environment) == (2, 1, {"LEVEL": "1"})
    assert spec.race is not None and spec.race.model_dump() == {
        **{"run": "racer-1", "checkpoint": 9, "trials": 5, "continuous": True, "off_track_penalty": 2.0, "keep": True},
        **{
            "crash_penalty": 1.0,
            "max_resets": 4,
            "seconds": 60.0,
            "track": ["oval", "hills"],
            "seed": 7,
            "config": CAR,
        },
    }
