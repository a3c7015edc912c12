import math


def find_target(waypoints, start, x, y, radius):
    n = len(waypoints)
    for k in range(n):
        point = waypoints[(start + k) % n]
        if math.hypot(point[0] - x, point[1] - y) >= radius:
            return point
    return waypoints[start]


def reward_function(params):
    x, y = params["x"], params["y"]
    tx, ty = find_target(params["waypoints"], params["closest_waypoints"][1], x, y, params["track_width"] * 0.9)
    requested = math.degrees(math.atan2(ty - y, tx - x)) - params["heading"]
    requested = (requested + 180.0) % 360.0 - 180.0
    error = (params["steering_angle"] - requested) / 60.0
    score = 1.0 - abs(error)
    return max(score, 0.01)
