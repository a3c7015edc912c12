"""The arrays of a finished model on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp


def numbers(array: wp.array[Any] | None) -> np.ndarray:
    """The content of an array that Newton declares as optional and every finished model has."""
    assert array is not None
    content: np.ndarray = array.numpy()
    return content
