"""Webhooks: the receivers of messages about ended jobs, and the signature of a message.

They are those of the file that the operator gave at a start last, and no others: a URL in a user's YAML would let any user make the
controller connect to what only the controller can reach. The database keeps them, sealed, for the starts without a file. Signatures follow Standard Webhooks (standardwebhooks.com).
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from orchestrator.domain.job import Status
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.own_secrets import WEBHOOKS, OwnSecrets
from orchestrator.spec.model import KINDS
from shared_store.contract.error_text import explain, path_of
from shared_store.volume.layout import NAME

PAUSES = (2, 10, 50, 250, 1250, 6250, 31250)
"""Seconds after each failed try; the eighth, about eleven hours after the first, is the last one."""
_PREFIX = "whsec_"
_SECRET_SIZES = range(24, 65)
"""Bytes, of Standard Webhooks."""


class WebhooksError(Exception):
    """The webhooks can't be used; one line without any secret: which key, why, and what to do."""


def _url(value: str) -> str:
    with suppress(ValueError):
        parts = urlsplit(value)
        if parts.scheme in ("http", "https") and parts.hostname and parts.port != 0:
            return value
    raise ValueError("expected a URL such as https://chat.example/hooks/muster")


def _secret(value: str) -> str:
    with suppress(ValueError):
        if value.startswith(_PREFIX) and len(_bytes(value)) in _SECRET_SIZES:
            return value
    raise ValueError(
        "expected whsec_ and 24 to 64 random bytes in base64; make one: echo whsec_$(openssl rand -base64 32)"
    )


def _bytes(secret: str) -> bytes:
    """Raises ValueError."""
    return base64.b64decode(secret.removeprefix(_PREFIX), validate=True)


def _kind(value: str) -> str:
    if value not in KINDS:
        raise ValueError(f"expected one of {', '.join(KINDS)}")
    return value


Url = Annotated[str, AfterValidator(_url)]


class Webhook(BaseModel):
    """One receiver."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, hide_input_in_errors=True)
    name: str = ""
    url: Url
    secret: Annotated[str, AfterValidator(_secret)] = Field(repr=False)
    statuses: list[Literal["SUCCEEDED", "FAILED"]] = Field(default=["SUCCEEDED", "FAILED"], min_length=1)
    queues: list[str] | None = None
    """Names of job queues; None: all."""
    kinds: list[Annotated[str, AfterValidator(_kind)]] | None = None
    """Of :data:`orchestrator.spec.model.KINDS`; None: all."""
    link: Url | None = None
    """URL at which the receiver's people reach this controller; None: the address at which it listens."""

    @property
    def receiver(self) -> str:
        """Scheme and host: the rest of a URL is often a secret."""
        parts = urlsplit(self.url)
        return f"{parts.scheme}://{parts.hostname}" + (f":{parts.port}" if parts.port else "")

    def wants(self, job: Job) -> bool:
        """Whether it gets a message about the end of this job; of an array as a whole, not of its children."""
        if job.parent is not None or job.status not in self.statuses:
            return False
        if self.queues is not None and job.queue not in self.queues:
            return False
        return self.kinds is None or kind_of(job) in self.kinds

    def headers(self, identity: str, timestamp: int, body: bytes) -> dict[str, str]:
        """The headers of a message: ``identity`` is the same at each try, ``timestamp`` is the Unix time of this one [s]."""
        signed = f"{identity}.{timestamp}.".encode() + body
        digest = hmac.new(_bytes(self.secret), signed, hashlib.sha256).digest()
        return {
            "content-type": "application/json",
            "webhook-id": identity,
            "webhook-timestamp": str(timestamp),
            "webhook-signature": f"v1,{base64.b64encode(digest).decode()}",
        }


def kind_of(job: Job) -> str:
    """The kind of a job, of :data:`orchestrator.spec.model.KINDS`; ``command`` where its spec has none, or its row is damaged."""
    spec = _spec(job)
    return next((kind for kind in KINDS if spec.get(kind)), "command")


def run_of(job: Job) -> str:
    """The run that a job trains, or whose checkpoint it evaluates, exports, records or renders."""
    section = _spec(job).get(kind_of(job))
    named = section.get("run") if isinstance(section, dict) else None
    return named if isinstance(named, str) and NAME.fullmatch(named) else job.run


def _spec(job: Job) -> Mapping[str, Any]:
    try:
        return job.gang.spec or {}
    except (ValueError, KeyError, TypeError, AttributeError):  # its row is damaged
        return {}


def read_webhooks(source: str) -> Sequence[Webhook]:
    """The webhooks of a JSON file, ``{"NAME": {"url": …, "secret": "whsec_…"}}``. Raises WebhooksError."""
    path = Path(source).expanduser()
    try:
        if path.stat().st_mode & 0o077:
            raise WebhooksError(f"{path}: others can read these secrets; chmod 600 {path}")
        found = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        problem = error.strerror if isinstance(error, OSError) else "not JSON"
        raise WebhooksError(f"{path}: webhooks can't be read ({problem})") from None
    return _webhooks(found, str(path))


def settle_webhooks(own: OwnSecrets, new: Sequence[Webhook] | None) -> Sequence[Webhook]:
    """The webhooks from now on: the ``new`` ones, which replace the database's; where None, the database's.

    Raises WebhooksError, SealError, DatabaseError.
    """
    if new is not None:
        own[WEBHOOKS] = json.dumps({each.name: each.model_dump(mode="json", exclude={"name"}) for each in new})
        return new
    kept = own.get(WEBHOOKS)
    return (
        _webhooks(json.loads(kept), "the database's webhooks (muster serve --webhooks FILE replaces them)")
        if kept
        else ()
    )


def _webhooks(found: Any, where: str) -> Sequence[Webhook]:
    """The webhooks of a document that comes from ``where``. Raises WebhooksError."""
    if not isinstance(found, dict):
        raise WebhooksError(f'{where}: expected a JSON object, {{"NAME": {{"url": "https://…", "secret": "whsec_…"}}}}')
    for name in found:
        if not NAME.fullmatch(name) or "name" in (found[name] if isinstance(found[name], dict) else {}):
            raise WebhooksError(
                f"{where}: {name[:60]!r} is not a name for a webhook: expected letters, digits, '.', '_' and '-'"
            )
    try:
        read = TypeAdapter(dict[str, Webhook]).validate_python(found)
    except ValidationError as error:
        first: Any = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in path_of(first))
        words = f"unknown key; valid here: {', '.join(_KEYS)}" if first["type"] == "extra_forbidden" else _words(first)
        raise WebhooksError(f"{where}: {key}: {words}") from None
    return [webhook.model_copy(update={"name": name}) for name, webhook in read.items()]


_KEYS = [name for name in Webhook.model_fields if name != "name"]


def _words(problem: Any) -> str:
    """The problem of a value, without the value where that is a secret, or a URL that may hold one."""
    if problem["type"] == "value_error":
        return str(problem["ctx"]["error"])
    return "expected a string" if problem["type"] == "string_type" else explain(problem)


def event_of(status: str) -> str:
    """The ``type`` of the message about a job that ended so."""
    return "job.succeeded" if status == Status.SUCCEEDED else "job.failed"
