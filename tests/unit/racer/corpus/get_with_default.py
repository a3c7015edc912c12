def reward_function(params):
    speed = params.get("speed", 1.0)
    bonus = params.get("bonus", 0.25)
    width = params["track_width"] if "track_width" in params else 1.0
    if "weather" in params:
        bonus += 1
    return max(speed * bonus - params.get("distance_from_center") / width, 0.0)
