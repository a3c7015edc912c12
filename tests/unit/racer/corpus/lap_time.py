EXPECTED_SECONDS = 22
STEPS_PER_SECOND = 15
BEHIND_STEPS = EXPECTED_SECONDS * STEPS_PER_SECOND


def reward_function(params):
    steps, progress = params["steps"], params["progress"]
    projected = steps / (progress / 100) if progress > 0.5 else BEHIND_STEPS
    pace = (projected - BEHIND_STEPS) / BEHIND_STEPS
    reward = max(1e-3, 1.0 - pace)
    if progress == 100:
        reward += 1500 * max(0.0, 1 - (steps - BEHIND_STEPS) / BEHIND_STEPS)
    return min(reward, 2000.0)
