from math import exp, pi, radians


def sigmoid(value):
    return 1.0 / (1.0 + exp(-value))


def reward_function(params):
    edge = params["distance_from_center"] / params["track_width"]
    calm = 1.0 - abs(radians(params["steering_angle"])) / (pi / 6)
    return sigmoid(8.0 * (0.35 - edge)) * (0.5 + 0.5 * calm) + 0.1 * sigmoid(params["speed"] - 2.0)
