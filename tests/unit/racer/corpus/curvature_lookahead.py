import math


def angle_between(p, q, r):
    first = math.atan2(q[1] - p[1], q[0] - p[0])
    second = math.atan2(r[1] - q[1], r[0] - q[0])
    diff = math.degrees(second - first)
    while diff > 180:
        diff -= 360
    while diff < -180:
        diff += 360
    return diff


def reward_function(params):
    waypoints = params["waypoints"]
    n = len(waypoints)
    start = params["closest_waypoints"][1]
    turn = 0.0
    for step in range(1, 8):
        p = waypoints[(start + step - 1) % n]
        q = waypoints[(start + step) % n]
        r = waypoints[(start + step + 1) % n]
        if p == q or q == r:
            continue
        turn += abs(angle_between(p, q, r))
    limit = 4.0 if turn < 10 else 2.5 if turn < 30 else 1.5
    speed = params["speed"]
    reward = 1.0 if speed <= limit else max(0.1, 1 - (speed - limit))
    return reward * (2.0 if params["all_wheels_on_track"] else 0.01)
