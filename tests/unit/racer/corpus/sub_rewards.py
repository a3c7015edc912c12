def distance_reward(params):
    half = params["track_width"] / 2
    return (1.0 - min(params["distance_from_center"], half) / half) ** 2


def speed_reward(params, top=4.0):
    return (params["speed"] / top) ** 2


def steering_reward(params):
    return 1.0 if abs(params["steering_angle"]) < 20 else 0.8


def reward_function(params):
    if params["is_offtrack"]:
        return 1e-3
    reward = 0.0
    reward += 2.0 * distance_reward(params)
    reward += speed_reward(params)
    reward *= steering_reward(params)
    reward += speed_reward(params, top=5.0)
    return reward
