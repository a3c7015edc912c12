def reward_function(params):
    steps = params["steps"]
    angle = int(params["steering_angle"])
    bucket = angle // 7
    phase = (bucket * steps - 13) % 11
    coarse = round(params["speed"])
    fine = round(params["distance_from_center"], 2)
    odd = -steps % 3
    return phase * 1.5 + coarse - fine + odd + (params["heading"] // 30) * 0.1 + (params["heading"] % -45) * 0.01
