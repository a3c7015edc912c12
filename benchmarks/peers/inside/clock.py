"""When each iteration of rsl_rl's runner ended, by the clock, with all that it logs and saves; nothing of the runner is replaced.

It imports rsl_rl alone, so that it works in every environment that has that.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


class Clock:
    """Notes what rsl_rl's runner does: install it before the runner is built.

    Args:
        began: When the process was started [s since 1970].
        worlds: How many worlds the runner trains on.
        steps: Control steps of every world in one iteration.
        wait: Waits until the device is done.
    """

    def __init__(self, began: float, worlds: int, steps: int, wait: Callable[[], None]) -> None:
        self._began, self._batch, self._wait = began, worlds * steps, wait
        self._started = 0.0
        self.runner: Any = None
        """The runner that trains, once it does."""
        self.startup = 0.0
        """Seconds from the start of the process to the first iteration."""
        self.curve: list[dict[str, Any]] = []
        """A point an iteration: ``seconds`` since training began, ``env_steps``, ``reward``, ``episode_length``, ``collect_s``,
        ``learn_s``."""
        self.checkpoints: list[dict[str, Any]] = []
        """``path``, ``iteration`` and ``seconds`` of each file that was saved."""

    def install(self) -> None:
        """Have rsl_rl's runners and loggers tell this clock."""
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

        OnPolicyRunner.learn, Logger.log = timed_learn, timed_log  # type: ignore[method-assign]

    def _logged(self, logger: Any, said: dict[str, Any]) -> None:
        self.curve.append(
            {
                "seconds": time.perf_counter() - self._started,
                "env_steps": (len(self.curve) + 1) * self._batch,
                "reward": statistics.mean(logger.rewbuffer) if logger.rewbuffer else None,
                "episode_length": statistics.mean(logger.lenbuffer) if logger.lenbuffer else None,
                "collect_s": said["collect_time"],
                "learn_s": said["learn_time"],
            }
        )

    def _saved(self, path: str) -> None:
        point = {"path": str(Path(path).resolve()), "iteration": len(self.curve)}
        self.checkpoints.append({**point, "seconds": time.perf_counter() - self._started})

    def write(self, path: str, **facts: Any) -> None:
        """Everything noted, and ``facts``, as JSON into ``path``."""
        found = {"startup_s": self.startup, "curve": self.curve, "checkpoints": self.checkpoints, **facts}
        Path(path).write_text(json.dumps(found, default=str))


def _note_saves(runner: Any, note: Callable[[str], None]) -> None:
    save = runner.save

    def timed_save(path: str, *arguments: Any, **options: Any) -> None:
        save(path, *arguments, **options)
        note(path)

    runner.save = timed_save


def versions(*names: str) -> dict[str, str]:
    """Versions of the packages that are installed."""
    from importlib.metadata import PackageNotFoundError, version

    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "-"
    return found


def device_facts() -> tuple[str, Callable[[], None]]:
    """What the device is called, and a function that waits for it."""
    import torch

    if torch.cuda.is_available():
        return torch.cuda.get_device_name(), torch.cuda.synchronize
    return "the CPU", lambda: None
