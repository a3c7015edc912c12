"""The native API of access keys: list them; make and delete them, while no other machine can reach the server.

A key that is made over a network would cross it in clear text, and a stolen key could make its own successors. So a server that listens
off loopback, or behind a proxy, leaves that to ``muster keys``, run by its own user on its own machine.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field

from orchestrator.api.http.requests import actor_of
from orchestrator.keys import Key, KeysError, KeyStore, KeyUsageError
from orchestrator.services.chosen_checkpoints import CONFLICT
from orchestrator.services.errors import ClientError
from orchestrator.services.permissions import Operation, Refusal, Shared

router = APIRouter()
_Value = TypeVar("_Value")


class KeyRequest(BaseModel):
    """A new key."""

    name: str = Field(max_length=128, description="who or what uses it")
    queues: list[str] = Field(default_factory=list, max_length=50, description="those that it may use; all where empty")
    read_only: bool = Field(default=False, alias="readOnly", description="it may look but change nothing")


@router.get("/keys")
def read_keys(request: Request) -> list[dict[str, Any]]:
    """The keys, without their secrets; for keys with all queues."""
    return [key.describe() for key in list_keys(request)]


@router.post("/keys")
def make_key(request: Request, body: KeyRequest) -> dict[str, Any]:
    """Create a key; only this answer has its ``secretAccessKey``. From the first key on everybody needs one. Only on loopback."""
    key = create_key(request, body.name, tuple(body.queues), body.read_only)
    return {**key.describe(), "secretAccessKey": key.secret}


@router.delete("/keys/{name}")
def remove_key(request: Request, name: str) -> dict[str, str]:
    """Delete a key, which is refused from the next request on. Only on loopback."""
    delete_key(request, name)
    return {"deleted": name}


def list_keys(request: Request) -> list[Key]:
    """All keys, by name. Raises ClientError."""
    actor = actor_of(request)
    actor.check_all_queues(Operation.READ_KEYS)
    return sorted(_carry_out(_store(request).load).values(), key=lambda key: key.name)


def create_key(request: Request, name: str, queues: tuple[str, ...], read_only: bool) -> Key:
    """A new key, with its secret. Raises ClientError."""
    store = _writable(request, Operation.CREATE_KEY)
    return _carry_out(lambda: store.create(name, queues, read_only))


def delete_key(request: Request, name: str) -> None:
    """Delete the key of this name. Raises ClientError."""
    store = _writable(request, Operation.DELETE_KEY)
    _carry_out(lambda: store.delete(name))


def is_writable(request: Request) -> bool:
    """Whether keys are made and deleted through this server."""
    return not request.app.state.access.reachable


def _store(request: Request) -> KeyStore:
    store: KeyStore | None = request.app.state.access.keys
    if store is None:
        raise ClientError("this server has no keys", 404)
    return store


def _writable(request: Request, operation: Operation) -> KeyStore:
    actor = actor_of(request)
    actor.check(operation, Shared())
    if not is_writable(request):
        command = "create" if operation is Operation.CREATE_KEY else "delete"
        raise Refusal(
            "AccessDeniedException",
            f"other machines can reach this server, so keys are made and deleted on its own one alone: muster keys {command} NAME",
        )
    return _store(request)


def _carry_out(body: Callable[[], _Value]) -> _Value:
    """Raises ClientError for errors of the keys' file, or of the name of a key."""
    try:
        return body()
    except KeyUsageError as error:
        raise ClientError(str(error)) from None
    except KeysError as error:
        raise ClientError(str(error), CONFLICT) from None
