"""Courses for the check of a reward function: the tracks of a job with their obstacles, as the samples have them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from racer.rewards.parameters import MOST_OBJECTS
from racer.rewards.samples import FINE_OVAL, Course, Placed
from racer.settings.task import RacerConfig
from racer.tracks.checks import BadTrack
from racer.tracks.circuit import Circuit, circuit_of
from racer.tracks.geometry import project
from racer.tracks.naming import RANDOM, resolve
from shared_store.contract.error_text import Refused
from shared_store.volume.layout import Store
from worker.settings.overrides import configured


def courses_of(circuit: Circuit) -> tuple[Course, ...]:
    """Each track of a circuit with its obstacles; of those that are drawn from seeds, which are alike, the first one."""
    found: dict[str, Course] = {}
    for track, poses in zip(circuit.tracks, circuit.obstacle_poses, strict=True):
        boxes = project(track, poses[:MOST_OBJECTS, :2])
        sides = zip(boxes.along.tolist(), boxes.distance.tolist(), boxes.left.tolist(), strict=True)
        objects = tuple(Placed(along, distance if left else -distance) for along, distance, left in sides)
        course = Course(track.name, objects, track.digest, of_job=track)
        found.setdefault(RANDOM if track.name.startswith(RANDOM) else track.name, course)
    return tuple(found.values())


def courses_for(config: Mapping[str, Any], store: Store | None) -> tuple[tuple[Course, ...], list[str]]:
    """The courses of a job's configuration as far as they are known here; an oval where none is.

    Args:
        config: Tracks and obstacles as a job's YAML has them; what is wrong with them is refused with the job's configuration.
        store: Where imported and made tracks lie; None: they are not known here.

    Returns:
        The courses; lines that say on which tracks the function is not tried.
    """
    notes, tracks = list[str](), []
    try:
        settings = configured(RacerConfig, config)
        for name in settings.tracks:
            try:
                tracks.append(resolve(name, store))
            except BadTrack as error:
                notes.append(f"it is not tried on track {name}, but on the job's nodes ({error})")
        if tracks:
            return courses_of(circuit_of(tracks, settings.obstacles)), notes
    except Refused as error:
        notes.append(f"it is tried on an oval, not on the job's tracks ({error})")
        return (FINE_OVAL,), notes
    return (FINE_OVAL,), [*notes, f"it is tried on an oval of {len(FINE_OVAL.track.center)} waypoints instead"]
