"""What each test costs, in the JUnit file: setup, call and teardown apart, and the processes that it started.

``python -m benchmarks.tests`` makes tables of these files.
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
    """An audit hook. It sees the processes that this one starts itself, not those that they start."""
    if event != "subprocess.Popen":
        return
    words = [str(word) for word in arguments[1]] if isinstance(arguments[1], list | tuple) else [str(arguments[1])]
    _started["processes"] += 1
    if words[0].endswith("/muster"):
        _started["servers" if "serve" in words else "commands"] += 1


sys.addaudithook(_count)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    report.user_properties.append((f"{call.when} seconds", round(call.duration, 3)))
    if call.when == "teardown":
        report.user_properties.extend(sorted(_started.items()))
        _started.clear()
    item.user_properties[:] = report.user_properties
    return report


def _processor() -> tuple[float, float]:
    """CPU time of this machine since its boot [clock ticks]: busy, and all."""
    ticks = [int(word) for word in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    return sum(ticks) - ticks[3] - ticks[4], sum(ticks)


def _kernels() -> int:
    """Number of compiled modules in the tests' cache; a directory that another process moves meanwhile is passed over."""
    return sum(name.endswith(".meta") for _, _, names in os.walk(os.environ["WARP_CACHE_PATH"]) for name in names)


class _Whole:
    """The facts of a whole run, in the file of the process that writes it."""

    def __init__(self) -> None:
        self.began, self.busy, self.kernels, self.load = time.time(), _processor(), _kernels(), os.getloadavg()[0]

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        busy, total = (after - before for after, before in zip(_processor(), self.busy, strict=True))
        if (xml := session.config.stash.get(xml_key, None)) is not None:
            xml.add_global_property("wall seconds", f"{time.time() - self.began:.1f}")
            xml.add_global_property("busy share of all cores", f"{busy / total:.3f}")
            xml.add_global_property("load before", f"{self.load:.2f}")
            xml.add_global_property("kernels compiled", str(_kernels() - self.kernels))


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Whole())
