"""Slow cars earn little."""


def reward_function(params):
    all_wheels_on_track = params["all_wheels_on_track"]
    speed = params["speed"]
    SPEED_THRESHOLD = 1.0
    if not all_wheels_on_track:
        reward = 1e-3
    elif speed < SPEED_THRESHOLD:
        reward = 0.5
    else:
        reward = 1.0
    return float(reward)
