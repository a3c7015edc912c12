"""From a reward function's Python to Warp: a function in C++ that the kernels of a task call (:func:`translate`)."""

from worker.racer.rewards.translation.translate import Translated, translate
from worker.racer.rewards.translation.values import Outside

__all__ = ["Outside", "Translated", "translate"]
