"""Authentication, in front of every request.

With a token or a key in force a request carries ``Authorization: Bearer …`` (the token, or ``ACCESS_KEY_ID:SECRET``) or an AWS
Signature Version 4 by a key of :mod:`orchestrator.persistence.access_keys`. Without either the server listens on loopback only, takes requests from
processes of its own user (:mod:`orchestrator.api.http.callers`), and ignores signatures, since AWS clients always sign with something.

A browser has the session of a login to the console (:mod:`orchestrator.console.login`) in a cookie. It counts for the console's pages
and for reading; what changes something through the API needs one of the above.
"""

from __future__ import annotations

import asyncio
import logging
import uuid
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any
from urllib.parse import quote

from starlette.requests import ClientDisconnect, cookie_parser
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from orchestrator.api.http import foreign_services
from orchestrator.api.http.access import Access, actor_of_key
from orchestrator.api.http.callers import Caller, user_name
from orchestrator.api.http.limits import RateLimit, RequestBody
from orchestrator.api.http.request_head import RequestHead
from orchestrator.api.http.signatures import ALGORITHM, Signed
from orchestrator.domain.errors import ClientError, RequestError
from orchestrator.domain.excerpts import LONGEST_ERROR, excerpt
from orchestrator.services.permissions import Actor, Refusal

log = logging.getLogger("muster.api")

LOGIN, LOGOUT, STATIC = "/login", "/logout", "/static/"
"""Paths of the console that need no key: where one is entered, and the files of its pages."""
_UNKNOWN = ("MissingAuthenticationToken", "UnrecognizedClientException")


class Guard:
    """The middleware that authenticates, limits and identifies; only admitted requests reach the application."""

    def __init__(self, app: ASGIApp, access: Access, limit: RateLimit) -> None:
        self.app, self.access, self.limit = app, access, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":  # the server's start and end: it takes no websockets
            await self.app(scope, receive, send)
            return
        started = False

        async def sending(message: Message) -> None:
            nonlocal started
            started = True
            await send(message)

        try:
            await self._serve(scope, receive, sending)
        except Exception as error:
            if started:
                raise  # half an answer can only be cut off
            log.error("%s %s failed", scope["method"], ascii(scope["path"][:200]), exc_info=error)
            answer = error_response("internal error; the controller's log has the details", 500, "ServerException")
            answer.headers["connection"] = "close"  # announced, so that a client does not send its next request here
            await answer(scope, receive, _with_request_id(send))

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        head = RequestHead(scope)
        if (service := head.foreign_service) is not None:
            await foreign_services.refusal(service, head.headers)(scope, receive, send)
            return
        body = RequestBody(receive, head.headers.get("content-length"), head.operation)
        try:
            actor = await self._admit(head, body, scope.get("state", {}).get("caller"))
            await body.read()
        except ClientDisconnect:
            return
        except ClientError as refusal:
            # a body that is not even HTTP is answered by uvicorn itself: it then must not see a second answer
            await asyncio.sleep(0)
            await _refused(head, refusal)(scope, receive, send)
            return
        scope.setdefault("state", {})["actor"] = actor
        await self.app(scope, body.receive, _with_request_id(send))

    async def _admit(self, head: RequestHead, body: RequestBody, caller: Caller | None) -> Actor:
        """The sender of the request. Raises ClientError if it is refused."""
        demanded = self.access.demanded()
        head.check_browser(loopback_only=not demanded)
        if head.path == "/healthz":
            return Actor("a health check", frozenset(), read_only=True)
        actor = Actor(f"address {head.client}")
        if head.path in (LOGIN, LOGOUT) or head.path.startswith(STATIC):
            self._count(actor, "")
            return Actor("a visitor", frozenset(), read_only=True)
        if demanded:
            try:
                actor = self._of_session(head) or await self._authenticate(head, body)
            except ClientError:
                if reason := self.limit.refusal_of_failures(head.client):
                    raise Refusal("TooManyRequestsException", reason, 429) from None
                self._count(actor, "")
                raise
        elif self.access.user is not None:
            actor = await self._local_user(self.access.user, caller)
        self._count(actor, head.operation)
        if actor.read_only and not head.reads:
            raise Refusal(
                "AccessDeniedException",
                f"{actor.name} is read-only: {head.method} {head.path} is refused; use a key that may write",
            )
        return actor

    @staticmethod
    async def _local_user(user: int, caller: Caller | None) -> Actor:
        """The controller's own user, where the process at the other end is that user's. Raises Refusal."""
        uid = await caller.uid() if caller else None
        name = user_name(user)
        if uid == user:
            return Actor(f"user {name}")
        sender = (
            f"this one comes from user {user_name(uid)}"
            if uid is not None
            else "the user of this one is unknown (it comes out of a container, or its process has ended)"
        )
        raise Refusal(
            "AccessDeniedException",
            f"without keys this controller takes requests from user {name} of its machine alone, and {sender}; ask {name} for a "
            "key: `muster keys create NAME` creates one",
        )

    def _of_session(self, head: RequestHead) -> Actor | None:
        """The actor of the console's session, where a session counts and nothing else is presented."""
        if "authorization" in head.headers or not (head.method in ("GET", "HEAD") or head.is_of_console):
            return None
        return self.access.session(session_of(head.headers, head.port))

    def _count(self, actor: Actor, operation: str) -> None:
        if reason := self.limit.refusal(actor.name, operation):
            raise Refusal("TooManyRequestsException", reason, 429)

    async def _authenticate(self, head: RequestHead, body: RequestBody) -> Actor:
        scheme, _, credentials = (head.single("authorization") or "").strip().partition(" ")
        if scheme.lower() == "bearer":
            await self._find_key(credentials.strip().partition(":")[0], head.client)
            return self.access.bearer(credentials.strip())
        if scheme == ALGORITHM:
            signed = Signed.parse(credentials)
            await self._find_key(signed.access_key_id, head.client)
            key = self.access.known().get(signed.access_key_id)
            if key is None:
                raise Refusal(
                    "UnrecognizedClientException",
                    f"The security token included in the request is invalid: there is no key "
                    f"{signed.access_key_id[:80]!r}; {self.access.way_in()}",
                )
            signed.check(head, datetime.now(UTC))
            signed.check_signature(head, await body.read(), key.secret)
            return actor_of_key(key)
        raise Refusal(
            "MissingAuthenticationToken",
            "a token is needed: set MUSTER_TOKEN (the server's token, or ACCESS_KEY_ID:SECRET of a key), send it as "
            f"'Authorization: Bearer …', or sign with AWS Signature Version 4; {self.access.way_in()}",
        )

    async def _find_key(self, access_key_id: str, client: str) -> None:
        """See a key that another process has just created; the loop does not wait for the database meanwhile.

        An address that has sent too many wrong keys causes no more reads.
        """
        if self.access.is_new(access_key_id) and not self.limit.fails_too_often(client):
            await asyncio.to_thread(self.access.reload)


def session_of(headers: Mapping[str, str], port: int | None) -> str:
    """The console's session in the cookie of a request to this port; empty where there is none."""
    return cookie_parser(headers.get("cookie", "")).get(cookie_name(port), "")


def cookie_name(port: int | None) -> str:
    """Browsers send a cookie to every port of a host, where other controllers may listen."""
    return f"muster-session-{port}"


def _refused(head: RequestHead, refusal: ClientError) -> Response:
    """The refusal; a person's browser without a session is sent to the login instead."""
    accepted = head.headers.get("accept", "")
    if head.method in ("GET", "HEAD") and "text/html" in accepted and kind_of(refusal) in _UNKNOWN:
        address = head.raw_path + (b"?" + head.query if head.query else b"")
        return RedirectResponse(f"{LOGIN}?next={quote(address.decode('latin-1'), safe='')}", 303)
    return error_response(str(refusal), refusal.status, kind_of(refusal))


def kind_of(error: RequestError) -> str:
    """AWS's name of an error."""
    return error.kind if isinstance(error, Refusal) else "ClientException"


def _with_request_id(send: Send) -> Send:
    """Every answer has the id that AWS's have; some clients always read it."""

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            identifier = (b"x-amzn-requestid", str(uuid.uuid4()).encode())
            message["headers"] = [*message.get("headers", []), identifier]
        await send(message)

    return sending


def error_response(
    message: str, status: int, kind: str = "ClientException", media_type: str | None = None
) -> JSONResponse:
    """An error that botocore maps to its class (by header and body) and that a person can read; its text is bounded here."""
    # it may repeat half of a character that was sent
    text = excerpt(message, LONGEST_ERROR).encode(errors="backslashreplace").decode()
    content: dict[str, Any] = {"__type": kind, "message": text}
    return JSONResponse(content, status, {"x-amzn-errortype": kind}, media_type=media_type)
