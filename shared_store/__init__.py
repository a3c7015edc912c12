"""The shared persistent volume: its layout, atomic commits, checkpoints, logs, metrics and outcomes.

Both sides of Muster import this package (``orchestrator`` → ``shared_store`` ← ``worker``); it imports neither of them, and no
torch. Only this package and the environment variables of :mod:`shared_store.contract` cross between the two.
"""

from __future__ import annotations

__version__ = "0.1.0"
