import math

WINDOW = 5


def mean_direction(points, first, window=WINDOW):
    sx, sy = 0.0, 0.0
    for k in range(window):
        p, q = points[(first + k) % len(points)], points[(first + k + 1) % len(points)]
        sx += q[0] - p[0]
        sy += q[1] - p[1]
    return math.atan2(sy, sx)


def reward_function(params):
    near = mean_direction(params["waypoints"], params["closest_waypoints"][0])
    far = mean_direction(params["waypoints"], params["closest_waypoints"][0], 12)
    bend = abs(math.sin(far - near))
    heading = math.radians(params["heading"])
    aligned = math.cos(near - heading)
    return max(0.001, aligned) * (params["speed"] if bend < 0.2 else 4.0 - params["speed"])
