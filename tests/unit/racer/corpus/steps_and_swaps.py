def reward_function(params):
    low, high = params["speed"], params["distance_from_center"] * 4
    if low > high:
        low, high = high, low
    a = b = 0
    for i in range(10, 0, -3):
        a, b = a + i, b + a
        a *= 2
        b -= i
    total = high - low
    total **= 2
    total /= 3
    total += (a & 3) + (b | 4)
    return total
