"""The native API's routes for access keys: list them; make and delete them, while no other machine can reach the server.

A key that is made over a network would cross it in clear text, and a stolen key could make its own successors. So a server that listens
off loopback, or behind a proxy, leaves that to ``muster keys``, run by its own user on its own machine.
"""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field

from orchestrator.api.http.access import Access
from orchestrator.api.http.requests import actor_of
from orchestrator.persistence.access_keys import Key
from orchestrator.services import keys

router = APIRouter()


class KeyRequest(BaseModel):
    """A new key."""

    name: str = Field(max_length=128, description="who or what uses it")
    queues: list[str] = Field(default_factory=list, max_length=50, description="those that it may use; all where empty")
    read_only: bool = Field(default=False, alias="readOnly", description="it may look but change nothing")
    share: str | None = Field(default=None, description="of its jobs; the letters and digits of the name by default")


@router.get("/keys")
def read_keys(request: Request) -> list[dict[str, Any]]:
    """The keys, without their secrets; for keys with all queues."""
    return [key.describe() for key in list_keys(request)]


@router.post("/keys")
def make_key(request: Request, body: KeyRequest) -> dict[str, Any]:
    """Create a key; only this answer has its ``secretAccessKey``. From the first key on everybody needs one. Only on loopback."""
    key = create_key(request, body.name, tuple(body.queues), body.read_only, body.share)
    return {**key.describe(), "secretAccessKey": key.secret}


@router.delete("/keys/{name}")
def remove_key(request: Request, name: str) -> dict[str, str]:
    """Delete a key, which is refused from the next request on. Only on loopback."""
    delete_key(request, name)
    return {"deleted": name}


def list_keys(request: Request) -> list[Key]:
    """All keys, by name. Raises ClientError."""
    return keys.listed(request.app.state.access.keys, actor_of(request))


def create_key(request: Request, name: str, queues: tuple[str, ...], read_only: bool, share: str | None) -> Key:
    """A new key, with its secret. Raises ClientError."""
    access: Access = request.app.state.access
    limits = {"read_only": read_only, "reachable": access.reachable}
    return keys.create(access.keys, actor_of(request), name, queues, share=share, **limits)


def delete_key(request: Request, name: str) -> None:
    """Delete the key of this name. Raises ClientError."""
    access: Access = request.app.state.access
    keys.delete(access.keys, actor_of(request), name, reachable=access.reachable)


def is_writable(request: Request) -> bool:
    """Whether keys are made and deleted through this server."""
    return not request.app.state.access.reachable
