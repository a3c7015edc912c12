"""Plug-ins in the control plane: their routes and pages, which serve what the plug-in has declared and nothing else."""

from __future__ import annotations

from collections.abc import Sequence

from fastapi import APIRouter, Depends, FastAPI, Request

from orchestrator.api.http.requests import actor_of
from orchestrator.services.permissions import AddedOperation, Refusal
from shared_store.contract.plugins import Plugin, load, plugins


def add_plugins(app: FastAPI) -> None:
    """Add the routes and pages of all plug-ins; before the console's own. Raises PluginError."""
    for plugin in plugins().values():
        _include(app, plugin, plugin.routers, "/api")
        _include(app, plugin, plugin.pages, "")


def _include(app: FastAPI, plugin: Plugin, places: Sequence[str], prefix: str) -> None:
    def check(request: Request) -> None:
        operation = AddedOperation(f"{request.method} {request.scope['route'].path}")
        if operation not in plugin.operations:
            words = (
                f"{operation} is refused for every key: its plug-in declares no permission for it (Plugin.operations)"
            )
            raise Refusal("AccessDeniedException", words)
        actor_of(request).check(operation)

    for place in places:
        checked = APIRouter(prefix=prefix, dependencies=[Depends(check)])
        checked.include_router(load(place))
        app.include_router(checked)
