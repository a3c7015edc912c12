"""Many conditions with and, or and not."""


def reward_function(params):
    d, w, s, a = (
        params["distance_from_center"],
        params["track_width"],
        params["speed"],
        abs(params["steering_angle"]),
    )
    good = not (params["is_offtrack"] or params["is_crashed"])
    centred = d < 0.2 * w
    if (good and centred and s > 2) or (good and not centred and s <= 2 and a > 10):
        reward = 2
    elif good and 0.5 < s <= 3.0 < a:
        reward = 1
    elif not good:
        return 0.001
    else:
        reward = 0.5
    bonus = centred and 0.5 or 0.25
    count = centred + (s > 1) + (a < 5)
    return reward + bonus + 0.1 * count
