"""An object that remembers the last step."""


class Reward:
    def __init__(self):
        self.last_steering = 0.0

    def reward_function(self, params):
        change = abs(params["steering_angle"] - self.last_steering)
        self.last_steering = params["steering_angle"]
        return 1.0 - change / 60.0


REWARD = Reward()


def reward_function(params):
    return REWARD.reward_function(params)
