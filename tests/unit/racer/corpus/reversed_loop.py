import math


def reward_function(params):
    points = params["waypoints"]
    now = params["closest_waypoints"][0]
    wiggle = 0.0
    last = None
    for back in reversed(range(1, 6)):
        p, q = points[now - back], points[now - back - 1]
        angle = math.atan2(p[1] - q[1], p[0] - q[0])
        wiggle += angle if back % 2 else -angle
    return 1.0 / (1.0 + abs(wiggle)) if last is None else 0.0
