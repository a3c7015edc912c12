"""Keep to the inside of the left-hand track."""


def reward_function(params):
    width = params["track_width"]
    side = 1 if params["is_left_of_center"] else -1
    position = side * params["distance_from_center"] / (width / 2)
    reward = 1.0 - abs(position - 0.4)
    return max(reward, 0.01)
