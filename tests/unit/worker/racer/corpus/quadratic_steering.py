"""Steering that fits the turn of the track."""

import math

K = 0.5
GAIN = {"distance": 1.2, "steering": 0.8, "speed": 0.6}


def normalise(angle):
    return math.atan2(math.sin(angle), math.cos(angle))


def track_turn(waypoints, index, ahead):
    n = len(waypoints)
    a, b, c = waypoints[index % n], waypoints[(index + ahead) % n], waypoints[(index + 2 * ahead) % n]
    before = math.atan2(b[1] - a[1], b[0] - a[0])
    after = math.atan2(c[1] - b[1], c[0] - b[0])
    return normalise(after - before)


def reward_function(params):
    turn = track_turn(params["waypoints"], params["closest_waypoints"][1], 3)
    wanted = max(-30.0, min(30.0, math.degrees(turn) * K))
    steering = 1.0 - (abs(params["steering_angle"] - wanted) / 60.0) ** 2
    distance = 1.0 - (2.0 * params["distance_from_center"] / params["track_width"]) ** 2
    total = GAIN["distance"] * distance + GAIN["steering"] * steering + GAIN["speed"] * params["speed"] / 4.0
    return total if total > 0.001 else 0.001
