"""Routers of pages: their errors are pages too, and every change needs the form's token."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException

from orchestrator.api.http.auth import kind_of
from orchestrator.api.http.store_route import StoreRoute
from orchestrator.console.forms import Unconfirmed, check_form
from orchestrator.console.pages import failure, wants_page
from orchestrator.domain.errors import ClientError, Unavailable
from shared_store.contract.error_text import explain
from shared_store.contract.plugins import PluginError
from shared_store.volume.files import DamagedFile


class PageRoute(APIRoute):
    """A route whose errors are pages."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handler = super().get_route_handler()

        async def respond(request: Request) -> Response:
            try:
                return await handler(request)
            except Unconfirmed as question:
                return question.response(request)
            except RequestValidationError as error:
                first = error.errors()[0]
                name = ".".join(map(str, first["loc"][1:])) or str(first["loc"][0])
                return failure(request, f"{name}: {explain(first)}", 400)
            except ClientError as error:
                return failure(request, str(error), error.status, kind_of(error))
            except DamagedFile as error:
                return failure(request, f"the store holds a damaged file: {error}", 409)
            except (Unavailable, PluginError) as error:
                return failure(request, str(error), 503 if isinstance(error, Unavailable) else 500, "ServerException")

        return respond


class StoredPageRoute(PageRoute, StoreRoute):
    """A route of a page that is made of what is in the store."""


def page_router(*repeatable: str, stored: bool = False) -> APIRouter:
    """A router for pages of the console.

    Args:
        repeatable: Query parameters that an address may have several times.
        stored: Whether its functions use the store.
    """

    def check_query(request: Request) -> None:
        for name in request.query_params:
            if (times := len(request.query_params.getlist(name))) > 1 and name not in repeatable:
                raise ClientError(f"the address has {name[:50]} {times} times; give it once")

    checks = [Depends(check_form), Depends(check_query)]
    return APIRouter(route_class=StoredPageRoute if stored else PageRoute, include_in_schema=False, dependencies=checks)


def finish(app: FastAPI) -> None:
    """Respond to browsers with a page at unknown addresses."""
    before: Any = app.exception_handlers[HTTPException]

    async def not_found(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        if wants_page(request):
            return failure(request, f"{request.url.path[:200]}: {error.detail}", error.status_code)
        response: Response = await before(request, error)
        return response

    app.add_exception_handler(HTTPException, not_found)
