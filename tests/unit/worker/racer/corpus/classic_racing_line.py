"""The two closest points of a racing line, by lists of distances."""

LINE = [[-2.0, -1.5, 3.9], [0.0, -1.4, 4.0], [2.0, -1.6, 2.6], [3.45, 0.0, 2.0], [2.0, 1.6, 3.2], [-2.0, 1.6, 2.6]]


def dist_2_points(x1, x2, y1, y2):
    return abs(abs(x1 - x2) ** 2 + abs(y1 - y2) ** 2) ** 0.5


def closest_2_racing_points_index(racing_coords, car_coords):
    distances = []
    for i in range(len(racing_coords)):
        distance = dist_2_points(
            x1=racing_coords[i][0], x2=car_coords[0], y1=racing_coords[i][1], y2=car_coords[1]
        )
        distances.append(distance)
    closest_index = distances.index(min(distances))
    distances_no_closest = distances.copy()
    distances_no_closest[closest_index] = 999
    second_closest_index = distances_no_closest.index(min(distances_no_closest))
    return [closest_index, second_closest_index]


def reward_function(params):
    first, second = closest_2_racing_points_index(LINE, [params["x"], params["y"]])
    wanted = (LINE[first][2] + LINE[second][2]) / 2
    return max(1e-3, 1.0 - abs(params["speed"] - wanted) / 4.0)
