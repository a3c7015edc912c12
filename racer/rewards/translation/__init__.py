"""From a reward function's Python to Warp: a function in C++ that the kernels of a task call (:func:`translate`)."""

from racer.rewards.translation.translate import Translated, translate
from racer.rewards.translation.values import Outside

__all__ = ["Outside", "Translated", "translate"]
