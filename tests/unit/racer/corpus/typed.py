"""Annotations, keyword-only arguments and a lambda."""

import math

LIMIT: float = 3.0
clip = lambda value, low, high: max(low, min(high, value))  # noqa: E731


def blend(a: float, b: float, *, share: float = 0.5) -> float:
    return a * (1 - share) + b * share


def reward_function(params: dict) -> float:
    speed: float = clip(params["speed"], 0.5, LIMIT)
    offset: float = params["distance_from_center"] / (params["track_width"] / 2)
    square = lambda value: value * value  # noqa: E731
    return blend(speed / LIMIT, 1.0 - square(offset), share=0.7) + math.floor(speed) * 0.1
