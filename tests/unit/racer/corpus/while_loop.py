import math


def reward_function(params):
    waypoints = params["waypoints"]
    i = params["closest_waypoints"][0]
    travelled = 0.0
    points = 0
    while travelled < 2.0:
        j = (i + 1) % len(waypoints)
        gap = math.sqrt((waypoints[j][0] - waypoints[i][0]) ** 2 + (waypoints[j][1] - waypoints[i][1]) ** 2)
        i = j
        if gap == 0:
            continue
        travelled += gap
        points += 1
        if points >= 50:
            break
    straight = math.dist(waypoints[i], waypoints[params["closest_waypoints"][0]])
    return params["speed"] * straight / travelled
