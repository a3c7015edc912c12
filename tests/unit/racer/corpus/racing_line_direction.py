import math


def reward_function(params):
    line = [
        (-2.0, -1.5), (-1.0, -1.45), (0.0, -1.4), (1.0, -1.48), (2.0, -1.6), (3.1, -1.1), (3.45, 0.0), (3.1, 1.1),
        (2.0, 1.6), (1.0, 1.48), (0.0, 1.4), (-1.0, 1.45), (-2.0, 1.6), (-3.1, 1.1), (-3.45, 0.0), (-3.1, -1.1),
    ]

    def dist_2_points(x1, x2, y1, y2):
        return abs(abs(x1 - x2) ** 2 + abs(y1 - y2) ** 2) ** 0.5

    def closest_index(skip):
        index, best = -1, float("inf")
        for i, (px, py) in enumerate(line):
            if i == skip:
                continue
            d = dist_2_points(x1=px, x2=params["x"], y1=py, y2=params["y"])
            if d < best:
                index, best = i, d
        return index, best

    def dist_to_racing_line(closest, second):
        a = abs(dist_2_points(x1=line[closest][0], x2=line[second][0], y1=line[closest][1], y2=line[second][1]))
        b = abs(dist_2_points(x1=params["x"], x2=line[closest][0], y1=params["y"], y2=line[closest][1]))
        c = abs(dist_2_points(x1=params["x"], x2=line[second][0], y1=params["y"], y2=line[second][1]))
        s = abs(-(a**4) + 2 * (a**2) * (b**2) + 2 * (a**2) * (c**2) - (b**4) + 2 * (b**2) * (c**2) - (c**4))
        return s**0.5 / (2 * a)

    first, _ = closest_index(-1)
    second, _ = closest_index(first)
    distance = dist_to_racing_line(first, second)
    heading = math.radians(params["heading"])
    after = line[(first + 1) % len(line)]
    before = line[first]
    requested = math.atan2(after[1] - before[1], after[0] - before[0])
    miss = abs(math.atan2(math.sin(requested - heading), math.cos(requested - heading)))
    return max(1e-3, 1 - distance / (params["track_width"] * 0.5)) + (1.0 - miss / math.pi)
