"""The HTTP application: routes, the guard in front of them, and errors in the shapes that clients expect."""

from __future__ import annotations

import hmac
import json
import logging
import threading
from typing import Any
from urllib.parse import urlsplit

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Receive, Scope, Send

from orchestrator.api import batch, native
from orchestrator.api.errors import ClientError
from orchestrator.controller import Controller
from shared_store import __version__

LARGEST_BODY = 1 << 20
"""Bytes of a request body; AWS takes 30 KiB for SubmitJob."""

log = logging.getLogger("muster.api")


class Guard:
    """Lets in who may come in.

    With a token: those who carry it. Without one the server listens on loopback only, and then requests that a web page could
    have made (another ``Host``, a foreign ``Origin``) are refused: a browser on this machine reaches loopback too.
    """

    def __init__(self, app: ASGIApp, token: str | None) -> None:
        self.app, self.token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and (refusal := self._refuse(scope)):
            await error_response(refusal, 403)(scope, receive, send)
            return
        await self.app(scope, receive, send)

    def _refuse(self, scope: Scope) -> str | None:
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        if self.token is not None:
            given = headers.get("authorization", "").removeprefix("Bearer ")
            if scope["path"] == "/healthz" or hmac.compare_digest(given.encode(), self.token.encode()):
                return None
            return "a token is needed: set MUSTER_TOKEN, or send it as 'Authorization: Bearer …'"
        host = urlsplit(f"//{headers.get('host', '')}").hostname or ""
        if host != "localhost" and host != "::1" and not host.startswith("127."):
            return f"host {host!r} is not this machine's loopback address"
        origin = headers.get("origin")
        if origin and urlsplit(origin).netloc != headers.get("host"):
            return "requests from other web pages are refused"
        return None


def create_app(controller: Controller, token: str | None = None) -> FastAPI:
    """The application over a controller; ``closing`` in its state ends the streams."""
    app = FastAPI(
        title="Muster", version=__version__, docs_url="/api/docs", openapi_url="/api/openapi.json", redoc_url=None
    )
    app.state.controller = controller
    app.state.closing = threading.Event()
    app.include_router(native.router)
    app.add_middleware(Guard, token=token)
    app.add_exception_handler(ClientError, _client_error)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(Exception, _server_error)

    @app.get("/healthz")
    def healthz() -> dict[str, str]:
        """Alive, and which version."""
        return {"status": "ok", "version": __version__}

    @app.post("/v1/{operation}", include_in_schema=False)
    async def aws_batch(operation: str, request: Request) -> JSONResponse:
        """AWS Batch: one POST an operation (rest-json)."""
        body = await _body(request)
        name = batch.operation_names().get(operation, operation)
        return JSONResponse(await run_in_threadpool(batch.call, controller, name, body))

    return app


def error_response(message: str, status: int, kind: str = "ClientException") -> JSONResponse:
    """An error that botocore maps to its class (by the header) and that a person can read."""
    return JSONResponse({"message": message}, status, {"x-amzn-errortype": kind})


async def _body(request: Request) -> Any:
    raw = b""
    async for chunk in request.stream():
        raw += chunk
        if len(raw) > LARGEST_BODY:
            raise ClientError(f"the request is larger than {LARGEST_BODY} bytes", 413)
    try:
        return json.loads(raw or b"{}")
    except (ValueError, RecursionError):
        raise ClientError("the request is not JSON") from None


async def _client_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, ClientError)
    return error_response(str(error), error.status)


async def _invalid(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    return error_response(f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}", 400)


async def _http_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    return error_response(f"{request.method} {request.url.path}: {error.detail}", error.status_code)


async def _server_error(request: Request, error: Exception) -> JSONResponse:
    log.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return error_response("internal error; the controller's log has the details", 500, "ServerException")
