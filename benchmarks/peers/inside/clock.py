"""Wall-clock end of each iteration of rsl_rl's runner, including its logging and saving; nothing of the runner is replaced.

It imports only rsl_rl, so it works in every environment with that.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock


class Clock:
    """Records the work of rsl_rl's runner; install it before building the runner.

    Args:
        began: Start of the process [s since 1970].
        worlds: Number of worlds.
        steps: Control steps of every world in one iteration.
        wait: Function that waits for the device.
    """

    def __init__(self, began: float, worlds: int, steps: int, wait: Callable[[], None]) -> None:
        self._began, self._batch, self._wait = began, worlds * steps, wait
        self._started = 0.0
        self.runner: Any = None
        """The runner that trains, once it does."""
        self.startup = 0.0
        """Seconds from the start of the process to the first iteration."""
        self.curve: list[dict[str, Any]] = []
        """One point per iteration: ``seconds`` since training began, ``env_steps``, ``reward``, ``episode_length``, ``collect_s``,
        ``learn_s``."""
        self.checkpoints: list[dict[str, Any]] = []
        """``path``, ``iteration`` and ``seconds`` of each saved file."""

    def install(self) -> None:
        """Make rsl_rl's runners and loggers report to this clock."""
        from rsl_rl.runners import OnPolicyRunner
        from rsl_rl.utils.logger import Logger

        learn, log = OnPolicyRunner.learn, Logger.log

        def timed_learn(runner: Any, *arguments: Any, **options: Any) -> None:
            self._wait()
            self.runner = runner
            self.startup, self._started = time.time() - self._began, time.perf_counter()
            _note_saves(runner, self._saved)
            learn(runner, *arguments, **options)

        def timed_log(logger: Any, *arguments: Any, **options: Any) -> None:
            log(logger, *arguments, **options)
            self._wait()
            self._logged(logger, options)

        mock.patch.object(OnPolicyRunner, "learn", timed_learn).start()
        mock.patch.object(Logger, "log", timed_log).start()

    def _logged(self, logger: Any, output: dict[str, Any]) -> None:
        self.curve.append(
            {
                "seconds": time.perf_counter() - self._started,
                "env_steps": (len(self.curve) + 1) * self._batch,
                "reward": statistics.mean(logger.rewbuffer) if logger.rewbuffer else None,
                "episode_length": statistics.mean(logger.lenbuffer) if logger.lenbuffer else None,
                "collect_s": output["collect_time"],
                "learn_s": output["learn_time"],
            }
        )

    def _saved(self, path: str) -> None:
        point = {"path": str(Path(path).resolve()), "iteration": len(self.curve)}
        self.checkpoints.append({**point, "seconds": time.perf_counter() - self._started})

    def write(self, path: str, **facts: Any) -> None:
        """Write all records, and ``facts``, as JSON to ``path``."""
        found = {"startup_s": self.startup, "curve": self.curve, "checkpoints": self.checkpoints, **facts}
        Path(path).write_text(json.dumps(found, default=str))


def _note_saves(runner: Any, note: Callable[[str], None]) -> None:
    save = runner.save

    def timed_save(path: str, *arguments: Any, **options: Any) -> None:
        save(path, *arguments, **options)
        note(path)

    runner.save = timed_save


def versions(*names: str) -> dict[str, str]:
    """Versions of the installed packages."""
    from importlib.metadata import PackageNotFoundError, version

    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "-"
    return found


def device_facts() -> tuple[str, Callable[[], None]]:
    """Name of the device, and a function that waits for it."""
    import torch

    if torch.cuda.is_available():
        return torch.cuda.get_device_name(), torch.cuda.synchronize
    return "the CPU", lambda: None
