"""Guard clauses."""


def reward_function(params):
    if params["is_offtrack"]:
        return 0.001
    if params["is_crashed"]:
        return 0.001
    if params["is_reversed"]:
        return 0.01
    if params["progress"] >= 100:
        return 1000.0
    return params["speed"]
