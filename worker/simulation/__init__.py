"""Vectorised Newton worlds: building, stepping, graph capture and episode bookkeeping."""

import importlib
import sys
from importlib.util import find_spec

import warp as wp

# Set before the import of newton, which fixes the options of its kernels. Nothing here is differentiated, and backward passes would more
# than double the code compiled at the first start.
wp.config.enable_backward = False

if "newton" not in sys.modules and "rerun" not in sys.modules and find_spec("rerun") is not None:
    # Where Rerun is installed, Newton imports it for a viewer that nothing here uses: half a second and 220 MB in every rank.
    sys.modules["rerun"] = None  # type: ignore[assignment]
    try:
        importlib.import_module("newton")
    finally:
        del sys.modules["rerun"]
