"""The control plane, which decides when and where jobs run. Imports no torch, no warp, no newton, and nothing of ``worker``."""

from __future__ import annotations

from shared_store import __version__ as __version__
