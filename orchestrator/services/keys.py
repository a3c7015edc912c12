"""Access keys: list them; make and delete them, while no other machine can reach the server."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from orchestrator.domain.errors import ClientError, ServerError
from orchestrator.persistence.access_keys import Key, KeyStore, KeyUsageError
from orchestrator.services.chosen_checkpoints import CONFLICT
from orchestrator.services.permissions import Actor, Operation, Refusal, Shared

T = TypeVar("T")


def listed(keys: KeyStore | None, actor: Actor) -> list[Key]:
    """All keys, by name. Raises ClientError."""
    actor.check_all_queues(Operation.READ_KEYS)
    return sorted(_carried_out(_there(keys).load).values(), key=lambda key: key.name)


def create(
    keys: KeyStore | None,
    actor: Actor,
    name: str,
    queues: tuple[str, ...],
    *,
    read_only: bool,
    share: str | None,
    reachable: bool,
) -> Key:
    """A new key, with its secret.

    Args:
        keys: Where it is kept; None for a server without keys.
        actor: Who asks.
        name: Of the key.
        queues: Names of the queues that it may use; all where empty.
        read_only: Whether it may change nothing.
        share: Share identifier of its jobs; the letters and digits of its name where None.
        reachable: Whether other machines can reach the server.

    Raises:
        ClientError: A name can't be used, or the secret can't be sealed.
        Refusal: The actor may not make keys, or not here.
    """
    _check(actor, Operation.CREATE_KEY, reachable)
    return _carried_out(lambda: _there(keys).create(name, queues, read_only, share))


def delete(keys: KeyStore | None, actor: Actor, name: str, *, reachable: bool) -> None:
    """Delete the key of this name; as :func:`create`."""
    _check(actor, Operation.DELETE_KEY, reachable)
    _carried_out(lambda: _there(keys).delete(name))


def _there(keys: KeyStore | None) -> KeyStore:
    if keys is None:
        raise ClientError("this server has no keys", 404)
    return keys


def _check(actor: Actor, operation: Operation, reachable: bool) -> None:
    actor.check(operation, Shared())
    if reachable:
        command = "create" if operation is Operation.CREATE_KEY else "delete"
        raise Refusal(
            "AccessDeniedException",
            f"other machines can reach this server, so keys are made and deleted on its own one alone: muster keys {command} NAME",
        )


def _carried_out(body: Callable[[], T]) -> T:
    """Raises ClientError for a name that can't be used, and for the sealing key's errors."""
    try:
        return body()
    except KeyUsageError as error:
        raise ClientError(str(error)) from None
    except ServerError as error:
        raise ClientError(str(error), CONFLICT) from None
