"""The centre line, less for sharp steering."""

import math


def reward_function(params):
    steering = abs(params["steering_angle"])  # only how sharp it is
    reward = math.exp(-6 * params["distance_from_center"])
    ABS_STEERING_THRESHOLD = 15
    if steering > ABS_STEERING_THRESHOLD:
        reward *= 0.8
    return float(reward)
