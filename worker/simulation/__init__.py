"""Vectorised Newton worlds: building, stepping, graph capture and episode bookkeeping."""

import importlib
import sys
from importlib.util import find_spec

import warp as wp

# Set before newton is imported, which fixes the options of its kernels: nothing here is differentiated, and the
# backward passes are more than half of what a first start compiles.
wp.config.enable_backward = False

if "newton" not in sys.modules and "rerun" not in sys.modules and find_spec("rerun") is not None:
    # Newton imports Rerun for a viewer where it is installed: half a second and 220 MB in every rank. Nothing here uses that viewer.
    sys.modules["rerun"] = None  # type: ignore[assignment]
    try:
        importlib.import_module("newton")
    finally:
        del sys.modules["rerun"]
