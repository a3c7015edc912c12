"""Distance from a line of coordinates with speeds."""

import math

RACING_LINE = [
    [-2.0, -1.5, 3.9],
    [-1.5, -1.48, 3.8],
    [-1.0, -1.45, 3.9],
    [-0.5, -1.42, 4.0],
    [0.0, -1.4, 4.0],
    [0.5, -1.43, 4.0],
    [1.0, -1.48, 3.7],
    [1.5, -1.55, 3.0],
    [2.0, -1.6, 2.6],
    [2.6, -1.5, 2.2],
    [3.1, -1.1, 2.0],
    [3.4, -0.5, 2.0],
    [3.45, 0.0, 2.0],
    [3.4, 0.5, 2.1],
    [3.1, 1.1, 2.3],
    [2.6, 1.5, 2.7],
    [2.0, 1.6, 3.2],
    [1.0, 1.48, 3.9],
    [0.0, 1.4, 4.0],
    [-1.0, 1.45, 3.8],
    [-2.0, 1.6, 2.6],
    [-2.6, 1.5, 2.2],
    [-3.1, 1.1, 2.0],
    [-3.45, 0.0, 2.0],
    [-3.1, -1.1, 2.1],
    [-2.6, -1.45, 2.9],
]


def reward_function(params):
    x, y = params["x"], params["y"]
    best, best_index = 1e9, 0
    for i in range(len(RACING_LINE)):
        px, py, _ = RACING_LINE[i]
        d = math.sqrt((px - x) ** 2 + (py - y) ** 2)
        if d < best:
            best = d
            best_index = i
    optimal_speed = RACING_LINE[best_index][2]
    distance_reward = max(1e-3, 1 - best / (params["track_width"] * 0.5))
    speed_diff = abs(optimal_speed - params["speed"])
    if speed_diff <= 1:
        speed_reward = (1 - speed_diff**2) ** 2
    else:
        speed_reward = 0
    reward = 1.0 + 2.0 * distance_reward + 3.0 * speed_reward
    if not params["all_wheels_on_track"]:
        reward = 1e-3
    return float(reward)
