import math


def reward_function(params):
    points = params["waypoints"]
    here = (params["x"], params["y"])
    index = min(range(len(points)), key=lambda i: math.dist(points[i], here))
    gap = math.dist(points[index], here)
    return 1.0 / (0.2 + gap) + (0.5 if index in params["closest_waypoints"] else 0.0)
