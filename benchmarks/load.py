"""The load by other processes during a measurement: a table made on a loaded machine can't be compared with others.

The rule: other processes may use at most :data:`LIMIT` of the processors' time, before the first measurement and during each one.
Above it a benchmark stops and writes nothing more, or, with ``--loaded-anyway``, its table reports the load.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

LIMIT = 0.05
"""Greatest share of all processors' time that other processes may use."""
WATCHED = 3.0
"""Time of observing the machine before the first measurement [s]."""


def add_option(parser: argparse.ArgumentParser) -> None:
    """The option that measures in spite of the load."""
    parser.add_argument(
        "--loaded-anyway",
        action="store_true",
        help="measure even on a loaded machine; the table reports the load",
    )


def busy_seconds() -> float:
    """Processor time used since the start of the machine, all processes and (on a virtual machine) its neighbours together [s]."""
    fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
    user, nice, system, _, _, irq, softirq, steal = map(int, fields[:8])
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


def own_seconds(pid: str = "self") -> float:
    """Processor time used by this process and all processes that it started [s]."""
    total = 0.0
    with contextlib.suppress(OSError):  # the process just ended
        times = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:15]
        total = sum(map(int, times)) / os.sysconf("SC_CLK_TCK")
        for thread in Path(f"/proc/{pid}/task").iterdir():
            total += sum(map(own_seconds, (thread / "children").read_text().split()))
    return total


class Watch:
    """Measures the processor time of other processes (not started by this one) between two calls.

    Args:
        loaded_anyway: Continue above :data:`LIMIT`.

    Raises:
        SystemExit: The machine is loaded.
    """

    def __init__(self, loaded_anyway: bool) -> None:
        self._loaded_anyway = loaded_anyway
        self.average = os.getloadavg()[0]
        """Load average of the last minute at the start."""
        self._begin()
        time.sleep(WATCHED)
        self.start = self.check("before the first measurement")

    def _begin(self) -> None:
        self._began = time.monotonic(), busy_seconds() - own_seconds()

    def check(self, when: str) -> dict[str, Any]:
        """Use by other processes since the last call: ``others``, a share of all processors, and ``load_average``, at the start.

        Raises SystemExit above :data:`LIMIT`; ``when`` names the measurement in its message.
        """
        then, others = self._began
        self._begin()
        now, since = self._began
        share = max(0.0, since - others) / ((now - then) * (os.cpu_count() or 1))
        if share > LIMIT and not self._loaded_anyway:
            raise SystemExit(
                f"the machine is loaded: other processes used {100 * share:.0f} % of its processors {when} (load average "
                f"{self.average:.1f} at the start), and {100 * LIMIT:.0f} % is the limit. Nothing of that is written. Stop them, or "
                "measure with --loaded-anyway"
            )
        return {"others": share, "load_average": self.average}


def machine() -> str:
    """This machine in a few words, for the table of a benchmark that uses no GPU."""
    return f"{os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()}, no GPU used"


def reported(rows: Sequence[Mapping[str, Any]]) -> str:
    """A sentence for the table of ``rows``, each with its result of :meth:`Watch.check`."""
    known = [row for row in rows if "others" in row]
    if not known:
        return "What else ran on the machine was not recorded."
    most, average = max(row["others"] for row in known), max(row["load_average"] for row in known)
    text = (
        f"Other processes used at most {100 * most:.1f} % of the processors (load average {average:.1f} at the start)."
    )
    return text if most <= LIMIT else f"**The machine was loaded.** {text}"
