"""The entry point of the ``muster`` command: it starts first what takes longest."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence

_RUN_JOBS = frozenset({"run", "resume", "evaluate", "export", "record", "render", "view", "verify-resume"})
"""Commands that run a job on a controller of their own where none is running."""
_RUN_NONE = frozenset({"--help", "-h", "--server", "--dry-run"})


def main() -> None:
    """Run the command. Ranks import for longer than the controller does: on a controller of its own, both import at the same time."""
    gc.set_threshold(50_000)  # imports make many objects, which stay
    if runs_job(sys.argv[1:]):
        from orchestrator.engines.local.forks import prepare

        prepare()
    from orchestrator.cli import main as run

    try:
        run()
    finally:
        gc.freeze()  # the interpreter would look through all objects once more, for half a second, and then forget them


def runs_job(arguments: Sequence[str]) -> bool:
    """Whether the command with these arguments will run a job on a controller of its own."""
    is_one = arguments and arguments[0] in _RUN_JOBS and not _RUN_NONE.intersection(arguments)
    if not is_one or os.environ.get("MUSTER_URL"):
        return False
    from orchestrator.home import local_url

    return local_url() is None
