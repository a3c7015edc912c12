"""Vectorised Newton worlds: building, stepping, graph capture and episode bookkeeping."""

import warp as wp
from warp._src import context

from worker.deferred_imports import defer_imports

# Set before the import of newton, which fixes the options of its kernels. Nothing here is differentiated, and backward passes would more
# than double the code compiled at the first start.
wp.config.enable_backward = False
# Warp looks through each function for those that it calls, only to unload their callers where a module is imported a second time,
# as in a notebook. For two thousand functions of Newton and MuJoCo-Warp that is a quarter of their import.
if hasattr(context.Module, "_find_references"):
    context.Module._find_references = lambda module, adjoint: None  # type: ignore[method-assign]
defer_imports()
