"""Orders about tracks, carried out by a process of their own: the controller never imports numpy."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

from orchestrator.domain.errors import ServerError, UsageError

_PATIENCE = 120.0
"""Seconds that an order may take."""


def carry_out(order: Mapping[str, Any]) -> Any:
    """Give an order to :mod:`racer.tracks`, and return its answer.

    Args:
        order: ``action``, ``store`` (its path), ``output`` (a path, or None), and what the action takes.

    Raises:
        UsageError: The order can't be carried out; one line.
        ServerError: The worker is not installed here, or failed.
    """
    if find_spec("numpy") is None:
        raise ServerError("tracks need numpy, which this environment lacks: pip install 'muster[worker]'")
    command = [sys.executable, "-P", "-m", "racer.tracks", json.dumps(order)]
    try:
        process = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_PATIENCE)
    except subprocess.TimeoutExpired:
        raise ServerError(f"racer.tracks has not answered within {_PATIENCE:.0f} s; does the store answer?") from None
    lines = process.stderr.strip().splitlines() or [f"it ended with exit code {process.returncode}"]
    if process.returncode == 2:
        raise UsageError(lines[-1])
    if process.returncode:
        raise ServerError(f"racer.tracks: {lines[-1]}")
    return json.loads(process.stdout)
