"""All distances at once with NumPy."""

import numpy as np


def reward_function(params):
    points = np.array(params["waypoints"])
    distances = np.linalg.norm(points - np.array([params["x"], params["y"]]), axis=1)
    return float(1.0 / (0.1 + distances.min()))
