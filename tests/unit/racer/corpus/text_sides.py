"""Names of sides and modes, a print and a format."""

MODE = "race"


def reward_function(params):
    side = "left" if params["is_left_of_center"] else "right"
    pace = "slow"
    if params["speed"] > 2:
        pace = "fast"
    elif params["speed"] > 1:
        pace = "medium"
    reward = 0.1
    if MODE == "race" and pace == "fast":
        reward += 2
    if side == "left" and pace != "slow":
        reward += 1
    print(f"reward {reward:.2f} at {params['steps']}", side)
    return float(reward)
