SPEEDS = {0: 3.5, 15: 2.0, 30: 1.2}


def wanted_speed(angle):
    if angle < 7.5:
        return SPEEDS[0]
    if angle < 22.5:
        return SPEEDS[15]
    return SPEEDS[30]


def reward_function(params):
    wanted = wanted_speed(abs(params["steering_angle"]))
    miss = abs(params["speed"] - wanted) / wanted
    reward = max(1e-3, 1.0 - miss)
    if params["is_offtrack"] or params["is_crashed"] or params["is_reversed"]:
        reward = 1e-3
    return reward
