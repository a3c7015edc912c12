import math


def reward_function(params):
    reward = math.pow(params["progress"] / 100.0, 2) + math.log(1.0 + params["speed"])
    reward += math.tanh(params["steps"] / 100) - math.fabs(params["steering_angle"]) / 90
    if math.isclose(params["progress"], 100.0):
        reward += 10
    return reward
