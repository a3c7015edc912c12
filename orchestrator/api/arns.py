"""ARNs, and the references by which clients name things: by name, by ARN, by ``id#node``, ``id:child``."""

from __future__ import annotations

import re

REGION, ACCOUNT = "us-east-1", "000000000000"
PREFIX = f"arn:aws:batch:{REGION}:{ACCOUNT}:"


def job_arn(job_id: str) -> str:
    return f"{PREFIX}job/{job_id}"


def definition_arn(name: str, revision: int) -> str:
    return f"{PREFIX}job-definition/{name}:{revision}"


def queue_arn(name: str) -> str:
    return f"{PREFIX}job-queue/{name}"


def environment_arn(name: str) -> str:
    return f"{PREFIX}compute-environment/{name}"


def policy_arn(name: str) -> str:
    return f"{PREFIX}scheduling-policy/{name}"


def plain_name(reference: str) -> str:
    """The name in an ARN of any region and account; a plain name as it is."""
    return reference.rpartition("/")[2]


def split_reference(reference: str) -> tuple[str, int | None]:
    """Job id and node index of ``id``, ``arn``, ``id#N`` or ``arn#N``; an array's child ``id:N`` is an id of its own."""
    base, sign, node = plain_name(reference).partition("#")
    # longer than any index: not a number to look up, and Python refuses to read thousands of digits
    return (base, int(node)) if sign and re.fullmatch(r"[0-9]{1,6}", node) else (base, None if not sign else -1)


def split_arn(arn: str) -> tuple[str, str]:
    """Kind (``job-queue``, ``job`` …) and name of one of our ARNs. Raises ValueError."""
    match = re.fullmatch(r"arn:aws[a-z-]*:batch:[a-z0-9-]*:[0-9]*:([a-z-]+)/(.+)", arn)
    if not match:
        raise ValueError(f"{arn!r} is not an ARN of AWS Batch, such as {queue_arn('default')}")
    return match[1], match[2]
