import numpy as np


def reward_function(params):
    points = params["waypoints"]
    before, after = params["closest_waypoints"]
    dx = points[after][0] - points[before][0]
    dy = points[after][1] - points[before][1]
    direction = np.rad2deg(np.arctan2(dy, dx))
    miss = np.abs(direction - params["heading"])
    if miss > 180:
        miss = 360 - miss
    far = np.linalg.norm([params["x"] - points[after][0], params["y"] - points[after][1]])
    return float(np.exp(-miss / 45) + np.clip(params["speed"], 0, 3) / 3 - 0.1 * far)
