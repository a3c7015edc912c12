"""Warp structs filled by the types of their fields, and arrays as torch and the host see them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp


def filled(kind: Any, device: Any, zeros: tuple[int, ...] | None = None, **values: Any) -> Any:
    """An instance of a Warp struct.

    Args:
        kind: Type of the struct.
        device: Device of the arrays that are made.
        zeros: Shape of the arrays for which there is no value; None: those fields stay unset.
        values: Fields: numbers, Warp arrays, or values of arrays, which are copied to the device as the field's type.
    """
    made = kind()
    for name, field in kind.vars.items():
        is_array = hasattr(field.type, "ndim")
        if name in values:
            own = values[name]
            if is_array and not isinstance(own, wp.array):
                own = wp.array(own, dtype=field.type.dtype, device=device)
            setattr(made, name, own)
        elif is_array and zeros is not None:
            setattr(made, name, wp.zeros(zeros, dtype=field.type.dtype, device=device))
    return made


def views_of(arrays: Any, *names: str) -> dict[str, torch.Tensor]:
    """Live torch views of fields of a Warp struct, by name."""
    return {name: wp.to_torch(getattr(arrays, name)) for name in names}


def numbers(array: wp.array[Any] | None) -> np.ndarray:
    """The content of an array that Newton declares as optional and every finished model has."""
    assert array is not None
    content: np.ndarray = array.numpy()
    return content
