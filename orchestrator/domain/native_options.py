"""Options that go beyond AWS Batch; native jobs carry them in ``MUSTER_*`` variables of their definition."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from shared_store.contract.node import LOG_LIMIT


class MalformedOptions(ValueError):
    """A ``MUSTER_*`` variable that the controller reads has a value that ``muster submit`` would not write."""


@dataclass(frozen=True)
class NativeOptions:
    """A job's options, from its main node's variables; the defaults follow AWS."""

    is_native: bool = False
    """Whether the job came from a job YAML and gets Muster's defaults; otherwise it behaves as on AWS."""
    on_child_failure: str = "ignore"
    """``restart``, ``fail`` or ``ignore``."""
    preemptible: bool = False
    """Whether the job may be preempted by another."""
    run: str = ""
    """Name of the run that it continues or creates; empty: a run of its own."""
    directory: str = ""
    """Directory from which it was submitted; empty if unknown."""
    worlds: int | None = None
    """Worlds of the whole gang, for a training that continues a run; None: as before."""
    stall_timeout: float | None = None
    """Seconds without an iteration after which a rank counts as stuck."""
    log_limit: int = LOG_LIMIT
    """Bytes kept of each node's log."""

    @classmethod
    def read(cls, environment: Mapping[str, str]) -> NativeOptions:
        """Read the options in a node's variables. Raises MalformedOptions."""
        variables = {name[7:]: value for name, value in environment.items() if name.startswith("MUSTER_")}
        worlds = variables.get("WORLDS", "")
        try:
            return cls(
                is_native=bool(variables.get("ON_CHILD_FAILURE")),
                on_child_failure=variables.get("ON_CHILD_FAILURE", "ignore"),
                preemptible=variables.get("PREEMPTIBLE") == "1",
                run=variables.get("RUN", ""),
                directory=variables.get("DIRECTORY", ""),
                worlds=int(worlds) if worlds.isdecimal() and len(worlds) < 10 else None,
                stall_timeout=float(variables["STALL_TIMEOUT"]) if "STALL_TIMEOUT" in variables else None,
                log_limit=int(variables.get("LOG_LIMIT") or LOG_LIMIT),
            )
        except ValueError as error:
            raise MalformedOptions(f"a MUSTER_* variable is malformed: {error}") from None
