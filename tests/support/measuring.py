"""What each test costs, in the JUnit file: setup, call and teardown apart, the processes and servers that it started.

A plug-in of pytest: ``-p tests.support.measuring --junitxml FILE``. ``python -m benchmarks.tests`` makes tables of the files.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Generator
from pathlib import Path

import pytest
from _pytest.junitxml import xml_key

_started: Counter[str] = Counter()


def _count(event: str, arguments: tuple[object, ...]) -> None:
    """An audit hook: processes that this one starts itself; what those start is theirs."""
    if event == "subprocess.Popen":
        words = arguments[1]
        words = [str(word) for word in words] if isinstance(words, list | tuple) else [str(words)]
        _started["processes"] += 1
        _started["servers"] += "serve" in words
        _started["commands"] += any(word.endswith("/muster") for word in words[:1]) and "serve" not in words


sys.addaudithook(_count)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    item.user_properties.append((f"{call.when} seconds", round(call.duration, 3)))
    if call.when == "teardown":
        item.user_properties.extend(sorted((name, count) for name, count in _started.items() if count))
        _started.clear()
    report.user_properties = list(item.user_properties)
    return report


def _processor() -> tuple[float, float]:
    """CPU seconds of this machine since boot: busy ones, and all."""
    ticks = [int(word) for word in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    idle = ticks[3] + ticks[4]
    rate = os.sysconf("SC_CLK_TCK")
    return (sum(ticks) - idle) / rate, sum(ticks) / rate


def _kernels() -> int:
    cache = Path(os.environ["WARP_CACHE_PATH"])
    return sum(1 for _ in cache.rglob("*.meta"))


class _Whole:
    """The facts of a whole run, in the file of the process that writes it."""

    def __init__(self) -> None:
        self.began, self.busy, self.kernels, self.load = time.time(), _processor(), _kernels(), os.getloadavg()[0]

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        busy, total = (after - before for after, before in zip(_processor(), self.busy, strict=True))
        xml = session.config.stash.get(xml_key, None)
        if xml is not None:
            xml.add_global_property("wall seconds", f"{time.time() - self.began:.1f}")
            xml.add_global_property("busy share of all cores", f"{busy / total:.3f}")
            xml.add_global_property("load before", f"{self.load:.2f}")
            xml.add_global_property("kernels compiled", str(_kernels() - self.kernels))


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Whole())
