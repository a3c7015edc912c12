"""Plug-ins in the control plane: their routes and pages, which serve what the plug-in has declared and nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import product

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.routing import APIRoute
from starlette.routing import BaseRoute

from orchestrator.api.http.requests import actor_of
from orchestrator.services.permissions import AddedOperation, Refusal
from shared_store.contract.plugins import Plugin, PluginError, load, plugins


def add_plugins(app: FastAPI) -> None:
    """Add the routes and pages of all plug-ins, after the controller's own.

    Raises PluginError: a part is not a router or can't be imported, a route exists already or can't be guarded by a permission,
    or an operation or an entry of the navigation has no route.
    """
    taken = [(operation, "the controller") for operation in _operations(_routes(app.routes))]
    for name, plugin in plugins().items():
        routes = list(_included(app, name, plugin))
        served = _operations(routes)
        for one, (other, owner) in product(served, taken):
            if _overlap(one, other):
                raise PluginError(
                    f"plug-in {name}: its route {one} is also that of {owner} ({other}); choose another path"
                )
        for operation in plugin.operations:
            if operation not in served:
                raise PluginError(
                    f"plug-in {name}: operations: no route of it serves {operation}; available: {_list(served)}"
                )
        for label, path in plugin.navigation:
            if f"GET {path}" not in served:
                raise PluginError(f"plug-in {name}: navigation: no page of it serves {path}, to which {label} leads")
        taken += [(operation, f"plug-in {name}") for operation in served]


def _included(app: FastAPI, name: str, plugin: Plugin) -> Iterator[tuple[BaseRoute, str]]:
    """Add the routers of a plug-in. Returns its routes, each with its whole path."""
    paths: dict[int, list[str]] = {}

    def check(request: Request) -> None:
        # a router that is included twice has one route under two paths: then both have to be declared
        operations = [AddedOperation(f"{request.method} {path}") for path in paths.get(id(request.scope["route"]), ())]
        undeclared = [each for each in operations if each not in plugin.operations]
        if undeclared or not operations:
            words = f"{undeclared[0] if undeclared else request.method} is refused for every key: its plug-in declares no permission for it"
            raise Refusal("AccessDeniedException", f"{words} (Plugin.operations)")
        for each in operations:
            actor_of(request).check(each)

    for place, prefix in (*((each, "/api") for each in plugin.routers), *((each, "") for each in plugin.pages)):
        before = len(app.routes)
        try:
            app.include_router(load(place, APIRouter), prefix=prefix, dependencies=[Depends(check)])
        except (AssertionError, RuntimeError) as error:  # FastAPI refuses it
            raise PluginError(f"plug-in {name}: {place} is not a usable router ({error})") from error
        for route, path in _routes(app.routes[before:]):
            if not isinstance(route, APIRoute):
                raise PluginError(
                    f"plug-in {name}: {place}: {path or '/'} is a {type(route).__name__}, which no permission could guard; "
                    "declare it with the router's get, post, put, patch or delete"
                )
            paths.setdefault(id(route), []).append(path)
            yield route, path


def _routes(routes: Iterable[BaseRoute], prefix: str = "") -> Iterator[tuple[BaseRoute, str]]:
    """All routes, each with its whole path, also those of routers in routers, which FastAPI 0.137 and later keep apart."""
    for route in routes:
        inner = getattr(route, "original_router", None)
        if isinstance(inner, APIRouter):
            # and the folders of APIRouter.frontend, which it serves where no other route does
            within = (*inner.routes, *getattr(inner, "_low_priority_routes", ()))
            yield from _routes(within, prefix + route.include_context.prefix)  # type: ignore[attr-defined]
        else:
            yield route, prefix + getattr(route, "path", "")


def _operations(routes: Iterable[tuple[BaseRoute, str]]) -> list[str]:
    return [f"{method} {path}" for route, path in routes for method in sorted(getattr(route, "methods", None) or ())]


def _overlap(one: str, other: str) -> bool:
    """Whether a request may be for both operations. A parameter stands for any text, one of kind ``path`` for several parts, too."""
    return _meet(one.split("/"), other.split("/"))


def _meet(one: list[str], other: list[str]) -> bool:
    if not one or not other:
        return one == other
    if ":path}" in one[0] + other[0]:
        return True
    (begin, _, one_rest), (start, _, other_rest) = one[0].partition("{"), other[0].partition("{")
    if not one_rest and not other_rest:
        alike = begin == start
    else:
        end, close = (part.rpartition("}")[2] for part in (one[0], other[0]))
        alike = (begin.startswith(start) or start.startswith(begin)) and (end.endswith(close) or close.endswith(end))
    return alike and _meet(one[1:], other[1:])


def _list(operations: list[str]) -> str:
    return ", ".join(sorted(operations)) or "none"
