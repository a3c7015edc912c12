import math


def reward_function(params):
    x, y = params["x"], params["y"]
    gaps = [math.dist((x, y), where) for where in ((0.0, 0.0), (1.0, -1.0), (2.0, 2.0))]
    near = sum(1 for where in params["objects_location"] if math.hypot(where[0] - x, where[1] - y) < 1.0)
    ahead = [d for d in (1, 2, 3)]
    blocked = any(
        abs(way - params["projection_distance"]) < 1.5 and left == params["is_left_of_center"]
        for way, left in zip(params["objects_distance"], params["objects_left_of_center"])
    )
    slow = all(speed < 3.5 for speed in params["objects_speed"])
    reward = 2.0 - 0.5 * near + 0.1 * len(ahead) + 0.01 * min(gaps) - 0.01 * max(gaps)
    if blocked:
        reward *= 0.3
    return max(0.0, reward + (0.2 if slow else 0.0))
