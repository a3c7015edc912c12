"""From a reward function's Python to Warp: a function in C++ that the kernels of a task call (:func:`translate`)."""

from racer.rewards.translation.expression_values import Outside
from racer.rewards.translation.translate import Translated, translate

__all__ = ["Outside", "Translated", "translate"]
