BANDS = [(0.0, 0.1), (1.0, 0.4), (2.0, 0.8), (3.0, 1.2)]
PENALTY = 0.7 * 0.5
MAX_STEERING = 30.0


def reward_function(params):
    reward = 0.0
    for least, value in BANDS:
        if params["speed"] >= least:
            reward = value
    if abs(params["steering_angle"]) > MAX_STEERING * 0.8:
        reward -= PENALTY
    return reward if reward > 0 else 0.001
