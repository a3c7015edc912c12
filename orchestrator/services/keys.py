"""Access keys: list them; make and delete them, while no other machine can reach the server."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from orchestrator.domain.errors import ClientError, ServerError
from orchestrator.persistence.access_keys import Key, KeyStore, KeyUsageError
from orchestrator.services.chosen_checkpoints import CONFLICT
from orchestrator.services.permissions import Actor, Operation, Refusal, Shared


def listed(keys: KeyStore | None, actor: Actor) -> list[Key]:
    """All keys, by name. Raises ClientError."""
    with _checked(keys, actor, Operation.READ_KEYS) as store:
        return sorted(store.load().values(), key=lambda key: key.name)


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
        name: Of the key.
        queues: Names of the queues that it may use; all where empty.
        read_only: Whether it may change nothing.
        share: Share identifier of its jobs; the letters and digits of its name where None.
        reachable: Whether other machines can reach the server.

    Raises:
        ClientError: A name can't be used, or the secret can't be sealed.
        Refusal: The actor may not make keys, or not here.
    """
    with _checked(keys, actor, Operation.CREATE_KEY, reachable) as store:
        return store.create(name, queues, read_only, share)


def delete(keys: KeyStore | None, actor: Actor, name: str, *, reachable: bool) -> None:
    """Delete the key of this name; as :func:`create`."""
    with _checked(keys, actor, Operation.DELETE_KEY, reachable) as store:
        store.delete(name)


@contextmanager
def _checked(keys: KeyStore | None, actor: Actor, operation: Operation, reachable: bool = False) -> Iterator[KeyStore]:
    """A block that uses the keys, where the actor may do this; their errors are ClientErrors in it. Raises ClientError, Refusal."""
    actor.check(operation, Shared())
    if operation.reads:
        actor.check_all_queues(operation)
    if reachable:
        command = "create" if operation is Operation.CREATE_KEY else "delete"
        raise Refusal(
            "AccessDeniedException",
            f"other machines can reach this server, so keys are created and deleted on its own machine alone: muster keys {command} NAME",
        )
    if keys is None:
        raise ClientError("this server has no keys", 404)
    try:
        yield keys
    except KeyUsageError as error:
        raise ClientError(str(error)) from None
    except ServerError as error:
        raise ClientError(str(error), CONFLICT) from None
