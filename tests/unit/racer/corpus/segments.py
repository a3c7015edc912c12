def project(px, py, ax, ay, bx, by):
    length = (bx - ax) ** 2 + (by - ay) ** 2
    if length == 0:
        return ax, ay, 0.0
    t = ((px - ax) * (bx - ax) + (py - ay) * (by - ay)) / length
    t = max(0, min(1, t))
    return ax + t * (bx - ax), ay + t * (by - ay), t


def reward_function(params):
    a, b = (params["waypoints"][i] for i in params["closest_waypoints"]) if False else (
        params["waypoints"][params["closest_waypoints"][0]],
        params["waypoints"][params["closest_waypoints"][1]],
    )
    qx, qy, t = project(params["x"], params["y"], a[0], a[1], b[0], b[1])
    gap = ((params["x"] - qx) ** 2 + (params["y"] - qy) ** 2) ** 0.5
    return 1.0 - gap / params["track_width"] + 0.01 * t
