"""All objects count; the closest one most."""


def reward_function(params):
    closest = 999.0
    for location in params["objects_location"]:
        dx = location[0] - params["x"]
        dy = location[1] - params["y"]
        distance = (dx**2 + dy**2) ** 0.5
        closest = min(closest, distance)
    reward = 1.0
    if closest < 0.3:
        reward = 1e-3
    elif closest < 1.0:
        reward = 0.2 + 0.8 * closest
    moving = 0
    for i in range(len(params["objects_speed"])):
        if params["objects_speed"][i] > 0.5:
            moving += 1
    return reward / (1 + moving)
