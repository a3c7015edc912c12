SPEEDS = {0: 3.5, 15: 2.0, 30: 1.2}


def expected_speed(angle):
    if angle < 7.5:
        return SPEEDS[0]
    if angle < 22.5:
        return SPEEDS[15]
    return SPEEDS[30]


def reward_function(params):
    requested = expected_speed(abs(params["steering_angle"]))
    miss = abs(params["speed"] - requested) / requested
    reward = max(1e-3, 1.0 - miss)
    if params["is_offtrack"] or params["is_crashed"] or params["is_reversed"]:
        reward = 1e-3
    return reward
