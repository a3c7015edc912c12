"""The outline of a track on the console's pages."""

from __future__ import annotations

import re

from racer.control.track_pages import drawn

RINGS = {
    "inner": [[0.0, 1.0], [4.0, 1.0], [8.0, 1.0]],
    "outer": [[0.0, 0.0], [4.0, 0.0], [8.0, 0.0]],
    "start": [[1.0, 1.0], [1.0, 0.0]],
}


def test_an_open_road_is_one_outline_and_a_loop_two() -> None:
    road, start = re.findall(r'd="([^"]+)"', drawn(RINGS, closed=False))
    assert road.count("M") == road.count("Z") == 1 and road.count("L") == 5
    assert drawn(RINGS).count("Z") == 2
    corners = [tuple(map(float, point.split())) for point in re.split("[ML]", start)[1:]]
    first = tuple(map(float, re.split("[MLZ]", road)[1].split()))
    # the start line is where the track says, one metre behind the first row of the borders
    assert len({x for x, _ in corners}) == 1 and corners[0][0] > first[0]
