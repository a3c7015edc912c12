LEFT = [20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32, 33, 34, 35, 36, 37, 38, 39, 40, 41, 42]
RIGHT = list_of_right = [60, 61, 62, 63, 64]
FAST = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18)


def reward_function(params):
    next_waypoint = params["closest_waypoints"][1]
    reward = 1e-3
    if next_waypoint in LEFT and params["is_left_of_center"]:
        reward += 10
    elif next_waypoint in RIGHT and not params["is_left_of_center"]:
        reward += 10.0
    elif next_waypoint not in LEFT:
        reward += 2.5
    if next_waypoint in FAST:
        if params["speed"] == 4:
            reward += 10
        elif params["speed"] >= 2:
            reward += 5
    return reward
