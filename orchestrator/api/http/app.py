"""The HTTP app: its routes, the guard in front of them, and errors in the shapes that clients expect."""

from __future__ import annotations

import json
import threading
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from sqlalchemy.exc import DataError
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from orchestrator.api.batch import operations as batch
from orchestrator.api.http import docs_page
from orchestrator.api.http.access import Access
from orchestrator.api.http.auth import Guard, error_response, kind_of
from orchestrator.api.http.limits import RateLimit, parse
from orchestrator.api.http.requests import IDEMPOTENCY_HEADER, actor_of
from orchestrator.api.logs import operations as logs
from orchestrator.api.native import routes as native
from orchestrator.control import exposition
from orchestrator.control.controller import Controller
from orchestrator.control.deliveries import Deliveries
from orchestrator.domain.errors import ClientError, RequestError, Unavailable
from orchestrator.services.permissions import Operation
from shared_store import __version__
from shared_store.contract.plugins import PluginError
from shared_store.volume.files import DamagedFile

BROWSER_HEADERS = [
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "DENY"),
    ("Content-Security-Policy", "frame-ancestors 'none'"),
    ("Referrer-Policy", "same-origin"),  # without a referrer a browser sends the origin of a page's own form as null
]
"""Headers of every answer, errors and refusals too, which the server adds: no page may frame an answer or guess its type."""


def create_app(
    controller: Controller,
    access: Access | None = None,
    limit: RateLimit | None = None,
    deliveries: Deliveries | None = None,
) -> FastAPI:
    """The application over a controller; ``closing`` in its state ends the streams. Without ``access``: for loopback only."""
    app = FastAPI(title="Muster", version=__version__, docs_url=None, openapi_url="/api/openapi.json", redoc_url=None)
    app.state.controller = controller
    app.state.deliveries = deliveries
    app.state.closing = threading.Event()
    app.include_router(native.router)
    app.state.access, app.state.limit = access or Access(), limit or RateLimit()
    app.add_middleware(Guard, access=app.state.access, limit=app.state.limit)
    for kind in (RequestError, RequestValidationError, HTTPException, DataError, Unavailable, PluginError, DamagedFile):
        app.add_exception_handler(kind, _refused)

    @app.get("/healthz")
    async def healthz() -> JSONResponse:
        """Alive, and which version; 503 with the reason while the loop is stuck, or the database or the store can't be used."""
        if (problem := controller.problem()) is not None:  # needs no thread: all of them may be busy
            return JSONResponse({"status": "unavailable", "message": problem, "version": __version__}, 503)
        return JSONResponse({"status": "ok", "version": __version__})

    @app.get("/metrics", response_class=PlainTextResponse)
    def metrics(request: Request) -> Response:
        """Metrics for Prometheus: jobs, waits, restarts, GPU-seconds used and lost, steps a second, hosts; for keys with all queues."""
        actor_of(request).check_all_queues(Operation.READ_MONITORING)
        return Response(exposition.exposition(controller), media_type=exposition.CONTENT_TYPE)

    @app.post("/v1/{operation}", include_in_schema=False)
    async def aws_batch(operation: str, request: Request) -> JSONResponse:
        """AWS Batch: one POST an operation (rest-json)."""
        body = await _body(request)
        name = batch.operation_names().get(operation, operation)
        key = request.headers.get(IDEMPOTENCY_HEADER)
        return JSONResponse(await run_in_threadpool(batch.call, controller, actor_of(request), name, body, key))

    @app.api_route("/v1/tags/{arn:path}", methods=["GET", "POST", "DELETE"], include_in_schema=False)
    async def aws_tags(arn: str, request: Request) -> JSONResponse:
        """AWS Batch's tags: the resource's ARN is in the path, percent-encoded."""
        name = {"GET": "ListTagsForResource", "POST": "TagResource", "DELETE": "UntagResource"}[request.method]
        body = await _body(request) if request.method == "POST" else {}
        if not isinstance(body, dict):
            raise ClientError(f"{name}: expected a JSON object")
        if request.method == "DELETE":
            body = {"tagKeys": request.query_params.getlist("tagKeys")}
        return JSONResponse(
            await run_in_threadpool(batch.call, controller, actor_of(request), name, {**body, "resourceArn": arn})
        )

    @app.get("/api/docs", include_in_schema=False)
    def describe() -> HTMLResponse:
        """The native API."""
        page = docs_page.render(app.openapi(), "/api/openapi.json")
        return HTMLResponse(page, headers={"Content-Security-Policy": docs_page.POLICY})

    @app.post("/", include_in_schema=False)
    async def cloudwatch_logs(request: Request) -> Response:
        """CloudWatch Logs: the operation in a header (JSON 1.1)."""
        target = request.headers.get("x-amz-target", "")
        return await logs.answer(controller, actor_of(request), app.state.closing, target, lambda: _body(request))

    return app


async def _body(request: Request) -> Any:
    """The request's JSON; its size is bounded by the guard."""
    try:
        text = (await request.body()).decode()
        value = parse(text or "{}")
        if "\\u" in text:  # JSON can say half of a character, which no answer and no log could repeat
            json.dumps(value, ensure_ascii=False).encode()
        return value
    except (ValueError, RecursionError):
        raise ClientError("the request is not JSON") from None


async def _refused(request: Request, error: Exception) -> JSONResponse:
    """The response to a request that was refused, or can't be carried out now."""
    match error:
        case RequestError():
            return error_response(str(error), error.status, kind_of(error))
        case RequestValidationError():
            first = error.errors()[0]
            return error_response(f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}", 400)
        case HTTPException():
            return error_response(f"{request.method} {request.url.path}: {error.detail}", error.status_code)
        case DataError():  # a zero byte, say, which PostgreSQL can't store nor look for
            return error_response(f"the database refuses a value ({str(error.orig).splitlines()[0][:200]})", 400)
        case DamagedFile():  # jobs write files on the volume, which may hold anything: that is not an error of the server
            return error_response(f"the store holds a damaged file: {error}", 409)
        case Unavailable():
            return error_response(str(error), 503, "ServerException")
    return error_response(str(error), 500, "ServerException")
