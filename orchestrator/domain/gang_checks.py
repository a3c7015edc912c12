"""Checks of a gang that is submitted: its variables, and Muster's options among them, by one set of rules for every submitter."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NewType

from orchestrator.domain.errors import ClientError
from orchestrator.domain.gang import GangSpec, gang_needs
from orchestrator.domain.native_options import MalformedOptions
from shared_store.contract.node import LEAST_LOG_LIMIT

CheckedGang = NewType("CheckedGang", GangSpec)
"""A gang that :func:`checked_gang` has read: only such a one is submitted."""

MOST_VARIABLES = 2500
"""Environment variables of a node. AWS's limits of a request's bytes leave room for fewer."""
LARGEST_ENVIRONMENT = 54 << 10
"""Bytes of a node's variables, names and values: those of a definition and of a submission, as large as AWS takes them."""
_MALFORMED = (
    "MUSTER_SPEC, MUSTER_STALL_TIMEOUT, MUSTER_LOG_LIMIT (bytes, at least 1048576) or MUSTER_RANKS_PER_NODE (at least 1) is malformed; "
    "they are written by `muster submit`"
)


def checked_gang(node_properties: Mapping[str, Any]) -> CheckedGang:
    """The gang that node properties, with all overrides applied, ask for. Raises ClientError, in one line, where it can't be submitted."""
    for entry in node_properties["nodeRangeProperties"]:
        _check_variables(entry["container"].get("environment") or [])
    try:
        gang = gang_needs(node_properties)
        _ = gang.spec  # whether it can be read
    except MalformedOptions:
        raise ClientError(_MALFORMED) from None
    except ValueError as error:
        raise ClientError(str(error)) from None
    options = gang.options
    stall = options.stall_timeout
    if not LEAST_LOG_LIMIT <= options.log_limit < 2**63 or (stall is not None and not 0 < stall < math.inf):
        raise ClientError(_MALFORMED)
    if options.on_child_failure not in ("restart", "fail", "ignore"):
        raise ClientError("MUSTER_ON_CHILD_FAILURE: expected restart, fail or ignore")
    return CheckedGang(gang)


def _check_variables(pairs: Sequence[Mapping[str, str]]) -> None:
    if len(pairs) > MOST_VARIABLES:
        raise ClientError(f"{len(pairs)} environment variables; a node has at most {MOST_VARIABLES}")
    size = 0
    for pair in pairs:
        name, value = pair["name"], pair.get("value", "")
        if not name:
            raise ClientError("an environment variable has no name; give it one")
        if name.startswith("AWS_BATCH"):
            raise ClientError(f"environment variable {name[:100]}: names that start with AWS_BATCH are reserved")
        if "=" in name or "\0" in name + value:
            raise ClientError(
                f"environment variable {name[:100]!r}: neither '=' in the name nor a zero byte is possible"
            )
        try:
            size += len((name + value).encode())
        except UnicodeEncodeError:
            raise ClientError(f"environment variable {name[:100]!r}: half of a character is not possible") from None
    if size > LARGEST_ENVIRONMENT:
        raise ClientError(
            f"a node's environment variables have {size} bytes, more than {LARGEST_ENVIRONMENT}; shorten them"
        )
