"""ARNs, and the references by which clients name things: by name, by ARN, by ``id#node``, ``id:child``."""

from __future__ import annotations

import re
from functools import partial

from orchestrator.control.account import DEFAULT, Account
from orchestrator.domain.errors import ClientError

_here = DEFAULT


def here() -> Account:
    """The account and region of the controller."""
    return _here


def settle(account: Account) -> None:
    """Make all ARNs those of this account from now on: a process has one controller."""
    global _here
    _here = account


def _prefix(service: str = "batch") -> str:
    return f"arn:{_here.partition}:{service}:{_here.region}:{_here.id}:"


def _arn(kind: str, name: str) -> str:
    return f"{_prefix()}{kind}/{name}"


job_arn, queue_arn, policy_arn, compute_environment_arn = (
    partial(_arn, kind) for kind in ("job", "job-queue", "scheduling-policy", "compute-environment")
)


def definition_arn(name: str, revision: int) -> str:
    return _arn("job-definition", f"{name}:{revision}")


def ecs_arn(kind: str, environment: str, name: str = "") -> str:
    """ARN of the ECS ``cluster`` that a compute environment would have, or with ``name`` that of an object in it (``task`` …)."""
    below = f"/{name}" if name else ""
    return f"{_prefix('ecs')}{kind}/AWSBatch-{environment}{below}"


def iam_arn(name: str) -> str:
    """ARN of the account's ``role/…`` or ``instance-profile/…``."""
    return f"arn:{_here.partition}:iam::{_here.id}:{name}"


def log_group_arn(name: str) -> str:
    """ARN of a log group, without the ``:*`` that AWS shows behind some."""
    return f"{_prefix('logs')}log-group:{name}"


def plain_name(reference: str, kind: str) -> str:
    """The name in an ARN of this controller's ``kind`` (``job``, ``job-queue`` …); any other text is returned unchanged. Raises ClientError."""
    if not reference.startswith("arn:"):
        return reference
    found, name = split_arn(reference)
    if found != kind:
        raise ClientError(f"{reference[:300]} is the ARN of a {found[:100]}, not of a {kind}")
    return name


def split_reference(reference: str) -> tuple[str, int | None]:
    """Job id and node index of ``id``, ``arn``, ``id#N`` or ``arn#N``; an array's child ``id:N`` is an id of its own.

    Raises ClientError for an ARN of something else.
    """
    base, sign, node = plain_name(reference, "job").partition("#")
    # longer than any index: not a number to look up, and Python refuses to read thousands of digits
    return (base, int(node)) if sign and re.fullmatch(r"[0-9]{1,6}", node) else (base, None if not sign else -1)


def split_arn(arn: str) -> tuple[str, str]:
    """Kind (``job-queue``, ``job`` …) and name of one of our ARNs. Raises ClientError for any other."""
    kind, slash, name = arn.removeprefix(_prefix()).partition("/")
    if not arn.startswith(_prefix()) or not slash or not kind or not name:
        raise ClientError(f"{arn[:300]!r} is not an ARN of this controller; its ARNs look like {queue_arn('default')}")
    return kind, name
