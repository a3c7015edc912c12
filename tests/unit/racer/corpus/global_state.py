"""A global variable that remembers the last progress."""

last_progress = 0.0


def reward_function(params):
    global last_progress
    gain = params["progress"] - last_progress
    last_progress = params["progress"]
    return max(0.001, gain)
