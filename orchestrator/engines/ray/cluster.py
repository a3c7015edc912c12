"""The controller's view of a Ray cluster: what a process that imports Ray says of it, and how to reach it."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

from orchestrator.engines.api import EngineError
from orchestrator.engines.toolkit.environment import INHERIT, inherited

_FRESH = 8.0
"""Seconds after which the last report is stale: the head does not answer."""
_STARTING = 40.0
"""Seconds that the watch may take for its first word."""


class ClusterWatch:
    """The state of the cluster, reported periodically by a process that imports Ray."""

    def __init__(self, head: str, environment: Mapping[str, str]) -> None:
        self.head, self._environment = head, environment
        self.seen: dict[str, Any] = {}
        """The last report, however old it is (see :meth:`problem`); empty before the first."""
        self._taken = -inf
        self._trouble = ""
        self._first, self._closing = threading.Event(), threading.Event()
        self._process: subprocess.Popen[str] | None = None
        threading.Thread(target=self._listen, name="ray watch", daemon=True).start()

    def first(self) -> dict[str, Any]:
        """The first report. Raises EngineError where the cluster can't be used."""
        self._first.wait(_STARTING)
        if not self.seen:
            self.close()
            raise EngineError(self._trouble or f"the Ray cluster at {self.head} does not answer")
        return self.seen

    def problem(self) -> str:
        """Why the last report is stale: nothing is known of the cluster now."""
        if time.monotonic() - self._taken < _FRESH:
            return ""
        return self._trouble or f"the Ray head at {self.head} does not answer"

    def close(self) -> None:
        self._closing.set()
        if self._process is not None:
            self._process.kill()

    def _listen(self) -> None:
        command = [sys.executable, "-P", "-m", "orchestrator.engines.ray.cluster_watch", self.head]
        while not self._closing.is_set():
            with tempfile.TemporaryFile("w+") as errors:
                self._process = subprocess.Popen(
                    command,
                    env=dict(self._environment),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=errors,
                    text=True,
                )
                assert self._process.stdout is not None
                for line in self._process.stdout:
                    if not line.startswith("{"):
                        continue  # a word of Ray's own
                    report = json.loads(line)
                    if "error" in report:
                        self._trouble = str(report["error"])
                    else:
                        self.seen, self._taken, self._trouble = report, time.monotonic(), ""
                    self._first.set()
                code = self._process.wait()
                if not self._first.is_set():
                    errors.seek(0)
                    self._trouble = _why_no_watch(code, errors.readlines())
                    self._first.set()
            self._closing.wait(2.0)


def _why_no_watch(code: int, errors: Sequence[str]) -> str:
    text = "".join(errors)
    if "No module named 'ray'" in text:
        return "the ray engine is not installed: pip install 'muster[ray]'"
    last = next((line for line in errors if "auth" in line.lower() or "token" in line.lower()), text.strip())
    return f"Ray can't be used: {last.strip().splitlines()[-1] if last.strip() else f'exit code {code}'}"


def ray_environment(head: str) -> dict[str, str]:
    """For a process that imports Ray: always with an explicit word about the token, since Ray aborts where sides differ."""
    own = inherited(prefixes=("PG",), kept=("RAY_AUTH_TOKEN", INHERIT))
    known = any(own.get(name) for name in ("RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"))
    mode = "token" if known or (Path.home() / ".ray" / "auth_token").exists() else "disabled"
    return {"RAY_AUTH_MODE": mode, **own, "RAY_ADDRESS": head, "RAY_USAGE_STATS_ENABLED": "0"}


def grows_to(text: str) -> list[dict[str, Any]]:
    """``4*{cpus:4,memory:8GiB,gpus:1}``, more of them with spaces between: how many machines of which shape there may be.

    For Ray's autoscaler v1, which tells nobody; v2 and KubeRay write it into the head's tables.
    """
    found = []
    for part in text.split():
        matched = re.fullmatch(r"([1-9][0-9]{0,3})\*\{([a-z]+:[0-9.]+[A-Za-z]*(?:,[a-z]+:[0-9.]+[A-Za-z]*)*)\}", part)
        fields = dict(field.split(":") for field in matched[2].split(",")) if matched else {}
        size = re.fullmatch(r"([0-9.]+)(GiB|MiB)", fields.get("memory", "1024MiB"))
        if not matched or not size or not fields.keys() <= {"cpus", "gpus", "memory"} or "cpus" not in fields:
            raise EngineError(f"MUSTER_RAY_GROWS_TO: {part!r} is not like 4*{{cpus:4,memory:8GiB,gpus:1}}")
        memory = int(float(size[1]) * (1024 if size[2] == "GiB" else 1))
        shape = {"cpus": float(fields["cpus"]), "gpus": int(fields.get("gpus", 0)), "memory": memory}
        found.append({**shape, "most": int(matched[1])})
    return found


def address_towards(head: str) -> str | None:
    """This machine's address on the way to the head; None for loopback."""
    host = head.rpartition(":")[0].strip("[]")
    try:
        family, _, _, _, target = socket.getaddrinfo(host, 9, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect(target)  # sends nothing: it only asks the kernel for the route
            address = str(probe.getsockname()[0])
    except OSError:
        return None
    return None if address.startswith("127.") or address == "::1" else address
