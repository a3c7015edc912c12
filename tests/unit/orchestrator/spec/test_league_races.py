"""The job of a race in a league: what it drives, where, and what it is called."""

from __future__ import annotations

from typing import Any

from orchestrator.spec.league_races import race_job
from shared_store.leagues import CAR, Rules
from tests.support.shared_store.leagues import league

TRAINED: dict[str, Any] = {
    "name": "racer",
    "queue": "robots",
    "environment": {"LEVEL": "1"},
    "nodes": 2,
    "resources": {"cpus": 2, "gpus": 4, "memory": 2048},
    "train": {"task": "Racer", "worlds": 8, "iterations": 9},
}
FACTS = {"run": "racer-1", "iteration": 9, "spec": TRAINED}


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


def test_two_keys_enter_one_model_under_different_names() -> None:
    names = [race_job(league(), "fast@3", FACTS, "lab", suffix).name for suffix in ("ada", "bob.b")]
    assert names == ["race-cup-fast-3-ada", "race-cup-fast-3-bob-b"]
    assert race_job(league("c" * 128), "fast@3", FACTS, "lab", "a" * 128).name == f"race-{'c' * 55}-{'a' * 39}"
