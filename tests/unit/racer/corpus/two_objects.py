def reward_function(params):
    reward = 1.0
    if not params["objects_location"]:
        return reward
    behind, front = params["closest_objects"]
    gap = params["objects_distance"][front] - params["projection_distance"]
    if gap < 0:
        gap += params["track_length"]
    closing = params["speed"] - params["objects_speed"][front]
    if closing > 0:
        time_to_crash = gap / closing
        if time_to_crash < 1.0:
            reward *= 0.1
        elif time_to_crash < 2.0:
            reward *= 0.5
    if abs(params["objects_heading"][behind] - params["heading"]) < 20:
        reward += 0.1
    return reward
