"""Plug-ins in the control plane: their routes and pages, which serve what the plug-in has declared and nothing else."""

from __future__ import annotations

from collections.abc import Sequence

from fastapi import APIRouter, Depends, FastAPI, Request
from starlette.routing import compile_path

from orchestrator.api.http.requests import actor_of
from orchestrator.services.permissions import AddedOperation, Refusal
from shared_store.contract.plugins import Plugin, load, plugins


def add_plugins(app: FastAPI) -> None:
    """Add the routes and pages of all plug-ins; before the console's own. Raises PluginError."""
    for plugin in plugins().values():
        _include(app, plugin, plugin.routers, "/api")
        _include(app, plugin, plugin.pages, "")


def _include(app: FastAPI, plugin: Plugin, places: Sequence[str], prefix: str) -> None:
    declared = [(AddedOperation(each), compile_path(each.partition(" ")[2])[0]) for each in plugin.operations]

    def check(request: Request) -> None:
        method, path, route = request.method, request.scope["path"], request.scope["route"].path
        for operation, pattern in declared:
            # of an included router, FastAPI tells a route's path without the prefix
            if operation.startswith(f"{method} ") and operation.endswith(route) and pattern.match(path):
                actor_of(request).check(operation)
                return
        words = f"{method} {prefix}{route.removeprefix(prefix)} is refused for every key: its plug-in declares no permission for it"
        raise Refusal("AccessDeniedException", f"{words} (Plugin.operations)")

    for place in places:
        checked = APIRouter(prefix=prefix, dependencies=[Depends(check)])
        checked.include_router(load(place))
        app.include_router(checked)
