"""Vectorised Newton worlds: building, stepping, graph capture and episode bookkeeping."""

import warp as wp

from worker.settings.deferred_imports import defer_imports
from worker.simulation.registration import register_lazily

# Set before the import of newton, which fixes the options of its kernels. Nothing here is differentiated, and backward passes would more
# than double the code compiled at the first start.
wp.config.enable_backward = False
register_lazily()
defer_imports()
