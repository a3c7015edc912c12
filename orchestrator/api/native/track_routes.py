"""The native API of the racer's tracks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fastapi import APIRouter, Query, Request

from orchestrator.api import permissions
from orchestrator.api.context import reconciler_of
from orchestrator.api.errors import ClientError
from orchestrator.api.permissions import Operation
from orchestrator.api.turns import Turns
from orchestrator.control.reconciler import Reconciler
from orchestrator.domain.errors import ServerError, UsageError
from orchestrator.spec.tracks import ask

router = APIRouter()
_turns = Turns("other tracks are being drawn")


@router.get("/tracks")
def list_tracks(
    request: Request,
    name: str | None = Query(default=None, max_length=130, description="this track alone, also ``random:SEED``"),
    rings: bool = Query(default=False, description="with the borders, for a drawing"),
) -> list[dict[str, Any]]:
    """The presets and the tracks of the store with their measures [m]; one that is damaged has a ``problem`` instead."""
    permissions.check(Operation.LIST_TRACKS)
    reconciler = reconciler_of(request)
    if name is None:
        found: list[dict[str, Any]] = _ask(reconciler, {"action": "list", "rings": rings})
        return found
    return [_ask(reconciler, {"action": "show", "name": name, "rings": rings})]


def picture(reconciler: Reconciler, name: str) -> bytes:
    """The PNG of a track. Raises ClientError."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "track.png"
        _ask(reconciler, {"action": "show", "name": name, "output": str(path)})
        return path.read_bytes()


def _ask(reconciler: Reconciler, order: Mapping[str, Any]) -> Any:
    try:
        with _turns.turn():
            return ask({**order, "store": str(reconciler.store.path)})
    except UsageError as error:
        raise ClientError(str(error), 404) from None
    except ServerError as error:
        raise ClientError(str(error), 503) from None
