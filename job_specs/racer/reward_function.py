"""A reward function for `job_specs/racer-reward.yaml`, in the form that AWS DeepRacer made known: fast, in the direction of the road,
and not near its edges. `python -m racer.rewards FILE` says whether one is valid."""

import math


def reward_function(params):
    if not params["all_wheels_on_track"]:
        return 1e-3
    waypoints = params["waypoints"]
    behind, ahead = params["closest_waypoints"]
    before, after = waypoints[behind], waypoints[ahead]
    direction = math.degrees(math.atan2(after[1] - before[1], after[0] - before[0]))
    miss = abs((direction - params["heading"] + 180) % 360 - 180)
    if miss > 30:
        return 1e-3
    middle = 1.0 - (2.0 * params["distance_from_center"] / params["track_width"]) ** 2
    return max(1e-3, middle) * params["speed"]
