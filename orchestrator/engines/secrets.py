"""Values of the ``secrets`` that a job definition names, from a file or the environment of this controller, where it allows that.

They reach a node's environment when it is launched, and nothing else: not the database, not an answer, not a log.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping, MutableMapping
from pathlib import Path
from typing import Any

_PREFIX = "MUSTER_SECRET_"
_MANAGER = re.compile(
    r"arn:aws[a-z-]*:secretsmanager:[^:]*:[^:]*:secret:([^:]+?)(?:-[A-Za-z0-9]{6})?(?::([^:]*):[^:]*:[^:]*)?"
)
_PARAMETER = re.compile(r"arn:aws[a-z-]*:ssm:[^:]*:[^:]*:parameter(/.+)")


class SecretsError(Exception):
    """Secrets can't be given; the message, one line without any value, says why and what to do."""


class Secrets:
    """The source of the secrets that this controller gives to jobs."""

    def __init__(self, source: str | None = None, environment: MutableMapping[str, str] = os.environ) -> None:
        """Args:
        source: Path of a JSON file that maps names to values, or to ``{"value": …, "queues": […]}`` for jobs of these queues
            alone; ``env`` for the variables ``MUSTER_SECRET_<name>`` of ``environment``; None to give no job any.
        environment: Loses these variables in any case: processes of jobs would inherit them.

        Raises SecretsError where the file can't be used.
        """
        self._file = Path(source).expanduser() if source not in (None, "env") else None
        self._allowed = source is not None
        self._environment: dict[str, str] = {}
        named = {name: environment.pop(name) for name in list(environment) if name.startswith(_PREFIX)}
        if source == "env":
            self._environment = {name.removeprefix(_PREFIX): value for name, value in named.items()}
        self._read()

    def of(self, container: Mapping[str, Any], queue: str) -> dict[str, str]:
        """The variables that ``secrets`` of these ``containerProperties`` ask for, with their values, for a job of this queue.

        Raises SecretsError.
        """
        secrets = container.get("secrets") or []
        if secrets and not self._allowed:
            raise SecretsError(
                f"secret {secrets[0]['name'][:100]}: this controller gives no secrets to jobs; start it with "
                "muster serve --secrets FILE (or env)"
            )
        known = self._read() if secrets else {}
        return {secret["name"]: self._value(secret, known, queue) for secret in secrets}

    def check(self, containers: Iterable[Mapping[str, Any]], queue: str) -> None:
        """Raises SecretsError where one of the containers asks for a secret that can't be given to a job of this queue."""
        for container in containers:
            self.of(container, queue)

    def _value(self, secret: Mapping[str, str], known: Mapping[str, Any], queue: str) -> str:
        reference = secret["valueFrom"]
        title = f"secret {secret['name'][:100]}: {reference[:300]!r}"
        name = next((name for name in _names(reference) if self._as_kept(name) in known), None)
        if name is None:
            where = self._file or f"the environment of the controller ({_PREFIX}<name>)"
            raise SecretsError(f"{title} is not in {where}; add it under this name")
        value, match = known[self._as_kept(name)], _MANAGER.fullmatch(reference)
        if isinstance(value, dict) and value.keys() == {"value", "queues"}:
            if not isinstance(value["queues"], list) or queue not in value["queues"]:
                raise SecretsError(f"{title} is not for job queue {queue}; add the queue in {self._file}")
            value = value["value"]
        if name != reference and match and (key := match[2]):
            try:
                value = json.loads(value)[key] if isinstance(value, str) else value[key]
            except (ValueError, KeyError, TypeError):
                raise SecretsError(f"{title} has no key {key[:100]!r}") from None
        text = value if isinstance(value, str) else json.dumps(value)
        if "\0" in text:
            raise SecretsError(f"{title} has a zero byte, which no variable can have")
        return text

    def _as_kept(self, name: str) -> str:
        """Names of variables have no slash."""
        return name if self._file else re.sub(r"\W", "_", name)

    def _read(self) -> Mapping[str, Any]:
        if self._file is None:
            return self._environment
        try:
            if self._file.stat().st_mode & 0o077:
                raise SecretsError(f"{self._file}: others can read these secrets; chmod 600 {self._file}")
            known = json.loads(self._file.read_bytes())
        except (OSError, ValueError) as error:
            problem = error.strerror if isinstance(error, OSError) else "not JSON"
            raise SecretsError(f"{self._file}: secrets can't be read ({problem})") from None
        if not isinstance(known, dict):
            raise SecretsError(f'{self._file}: expected a JSON object, {{"name": "value"}}')
        return known


def _names(reference: str) -> list[str]:
    """Under what a secret may be kept: all of its reference, or the name in it."""
    if match := _MANAGER.fullmatch(reference):
        return [reference, match[1], reference.split(":")[6]]
    if match := _PARAMETER.fullmatch(reference):
        return [reference, match[1], match[1][1:], match[1].rpartition("/")[2]]
    return [reference]
