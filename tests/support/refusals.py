"""What a call is refused with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


def refusal(call: Callable[..., Any], *arguments: Any, error: type[Exception] = ValueError, **options: Any) -> str:
    """The one line of the error that ``call`` raises."""
    with pytest.raises(error) as refused:
        call(*arguments, **options)
    assert "\n" not in str(refused.value)
    return str(refused.value)
