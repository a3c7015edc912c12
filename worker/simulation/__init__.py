"""Vectorised Newton worlds: building, stepping, graph capture and episode bookkeeping."""

import warp as wp

# Set before newton is imported, which fixes the options of its kernels: nothing here is differentiated, and the
# backward passes are more than half of what a first start compiles.
wp.config.enable_backward = False
