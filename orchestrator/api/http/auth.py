"""Authentication, in front of every request.

With a token or a key in force a request carries ``Authorization: Bearer …`` (the token, or ``ACCESS_KEY_ID:SECRET``) or an AWS
Signature Version 4 by a key of :mod:`orchestrator.persistence.access_keys`. Without either the server listens on loopback only, takes requests from
processes of its own user (:mod:`orchestrator.api.http.callers`), and ignores signatures, since AWS clients always sign with something.

A browser has the session of a login to the console (:mod:`orchestrator.console.login`) in a cookie. It counts for the console's pages
and for reading; what changes something through the API needs one of the above.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import re
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from typing import Any
from urllib.parse import SplitResult, quote, urlsplit

from starlette.requests import ClientDisconnect, cookie_parser
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from orchestrator.api.http import foreign_services as elsewhere
from orchestrator.api.http.access import Access, actor_of_key
from orchestrator.api.http.callers import Caller, user_name
from orchestrator.api.http.limits import RateLimit, RequestBody
from orchestrator.domain.errors import ClientError, RequestError
from orchestrator.domain.excerpts import LONGEST_ERROR, excerpt
from orchestrator.services.permissions import BY_LOWER_NAME, Actor, Refusal

log = logging.getLogger("muster.api")

SKEW = 15 * 60
"""Seconds that a signature's time may differ from the server's."""
_ALGORITHM = "AWS4-HMAC-SHA256"
_LOGS_TARGET = "Logs_20140328."
LOGIN, LOGOUT, STATIC = "/login", "/logout", "/static/"
"""Paths of the console that need no key: where one is given, and the files of its pages."""
_UNKNOWN = ("MissingAuthenticationToken", "UnrecognizedClientException")


class Guard:
    """The middleware that authenticates, limits and identifies; only admitted requests reach the application."""

    def __init__(self, app: ASGIApp, access: Access, limit: RateLimit) -> None:
        self.app, self.access, self.limit = app, access, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
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
            if started or scope["type"] != "http":
                raise  # half an answer can only be cut off
            log.error("%s %s failed", scope["method"], ascii(scope["path"][:200]), exc_info=error)
            answer = error_response("internal error; the controller's log has the details", 500, "ServerException")
            answer.headers["connection"] = "close"  # said, so that a client does not send its next request here
            await answer(scope, receive, _with_request_id(send))

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        request = _Request(scope)
        if scope["type"] == "http" and (service := request.foreign_service) is not None:
            await elsewhere.refusal(service, request.first_of_each())(scope, receive, send)
            return
        body = RequestBody(receive, request.first("content-length"), request.operation)
        try:
            actor = await self._admit(request, body, scope.get("state", {}).get("caller"))
            if scope["type"] == "http":
                await body.read()
        except ClientDisconnect:
            return
        except ClientError as refusal:
            if scope["type"] == "http":
                # a body that is not even HTTP is answered by uvicorn itself: it then must not see a second answer
                await asyncio.sleep(0)
                await _refused(request, refusal)(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": 1008, "reason": "refused"})  # the server answers 403
            return
        scope.setdefault("state", {})["actor"] = actor
        await self.app(scope, body.receive, _with_request_id(send))

    async def _admit(self, request: _Request, body: RequestBody, caller: Caller | None) -> Actor:
        """The sender of the request. Raises ClientError if it is refused."""
        demanded = self.access.demanded()
        request.check_browser(loopback_only=not demanded)
        if request.path == "/healthz":
            return Actor("a health check", frozenset(), read_only=True)
        actor = Actor(f"address {request.client}")
        if request.path in (LOGIN, LOGOUT) or request.path.startswith(STATIC):
            self._count(actor, "")
            return Actor("a visitor", frozenset(), read_only=True)
        if demanded:
            try:
                actor = self._of_session(request) or await self._authenticate(request, body)
            except ClientError:
                if reason := self.limit.refusal_of_failures(request.client):
                    raise Refusal("TooManyRequestsException", reason, 429) from None
                self._count(actor, "")
                raise
        elif self.access.user is not None:
            actor = await self._local_user(self.access.user, caller)
        self._count(actor, request.operation)
        if actor.read_only and not request.reads:
            raise Refusal(
                "AccessDeniedException",
                f"{actor.name} is read-only: {request.method} {request.path} is refused; use a key that may write",
            )
        return actor

    @staticmethod
    async def _local_user(user: int, caller: Caller | None) -> Actor:
        """The controller's own user, where the process at the other end is that user's. Raises Refusal."""
        uid = await caller.uid() if caller else None
        name = user_name(user)
        if uid == user:
            return Actor(f"user {name}")
        who = (
            f"it comes from user {user_name(uid)}"
            if uid is not None
            else "its user can't be seen from here (it comes out of a container, or its process has left)"
        )
        raise Refusal(
            "AccessDeniedException",
            f"without keys this controller takes requests from user {name} of its machine alone, and {who}; ask {name} for a key: "
            "`muster keys create NAME` makes one",
        )

    def _of_session(self, request: _Request) -> Actor | None:
        """The actor of the console's session, where a session counts and nothing else is presented."""
        if "authorization" in request.headers or not (request.method in ("GET", "HEAD") or request.is_of_console):
            return None
        return self.access.session(session_of(request.first_of_each(), request.port))

    def _count(self, actor: Actor, operation: str) -> None:
        if reason := self.limit.refusal(actor.name, operation):
            raise Refusal("TooManyRequestsException", reason, 429)

    async def _authenticate(self, request: _Request, body: RequestBody) -> Actor:
        given = request.single("authorization") or ""
        scheme, _, credentials = given.strip().partition(" ")
        if scheme.lower() == "bearer":
            await self._look_for(credentials.strip().partition(":")[0])
            return self.access.bearer(credentials.strip())
        if scheme == _ALGORITHM:
            claim = AuthorizationHeader.parse(credentials)
            await self._look_for(claim.access_key_id)
            key = self.access.known().get(claim.access_key_id)
            if key is None:
                raise Refusal(
                    "UnrecognizedClientException",
                    f"The security token included in the request is invalid: there is no key {claim.access_key_id[:80]!r}; "
                    "`muster keys list` shows the keys, `muster keys create NAME` makes one",
                )
            claim.check(request, datetime.now(UTC))
            claim.check_signature(request, key.secret, await body.read() if request.has_body else b"")
            return actor_of_key(key)
        raise Refusal(
            "MissingAuthenticationToken",
            "a token is needed: set MUSTER_TOKEN (the server's token, or ACCESS_KEY_ID:SECRET of a key), send it as "
            "'Authorization: Bearer …', or sign with AWS Signature Version 4; `muster keys create NAME` makes a key",
        )

    async def _look_for(self, access_key_id: str) -> None:
        """See a key that another process has just made; the loop does not wait for the database meanwhile."""
        if self.access.is_new(access_key_id):
            await asyncio.to_thread(self.access.look_again)


class _Request:
    """The facts that decide about a request, from its first line and its headers alone."""

    def __init__(self, scope: Scope) -> None:
        self.headers: dict[str, list[bytes]] = {}
        for name, value in scope["headers"]:
            self.headers.setdefault(name.decode("latin-1").lower(), []).append(value)
        self.has_body = scope["type"] == "http"
        self.method: str = scope.get("method", "GET")
        self.path: str = scope["path"]
        self.raw_path: bytes = scope["raw_path"]
        self.query: bytes = scope["query_string"]
        self.client: str = scope["client"][0] if scope.get("client") else "unknown"
        self.port: int | None = scope["server"][1] if scope.get("server") else None
        target = self.first("x-amz-target") or ""
        if self.method == "POST" and self.path == "/" and target.startswith(_LOGS_TARGET):
            name = target.removeprefix(_LOGS_TARGET)
        else:
            name = self.path.removeprefix("/v1/") if self.method == "POST" and self.path.startswith("/v1/") else ""
        plain = name.isascii() and name.isalnum()
        self.operation = name.lower() if plain else f"{self.method} {self.path}"
        """The AWS operation in lower case, else method and path."""
        known = BY_LOWER_NAME.get(self.operation)
        self.reads = self.method in ("GET", "HEAD", "OPTIONS") or (known is not None and known.reads)
        """Whether it changes nothing; an unknown operation counts as a change."""

    def first(self, name: str) -> str | None:
        """The header, the first where it was sent twice (as the application reads it)."""
        values = self.headers.get(name)
        return values[0].decode("latin-1") if values else None

    def first_of_each(self) -> dict[str, str]:
        return {name: values[0].decode("latin-1") for name, values in self.headers.items()}

    @property
    def is_of_console(self) -> bool:
        """Whether it is for the console, whose forms carry a token of their own, and not for an API."""
        return self.path != "/" and not self.path.startswith(("/v1/", "/api/"))

    @property
    def foreign_service(self) -> str | None:
        """The AWS service that the request is meant for, where it is none of ours."""
        return elsewhere.foreign_service(self.method, self.path, self.query, self.first_of_each())

    def single(self, name: str) -> str | None:
        """A header that decides about access. Raises Refusal where it was sent twice: which one would count?"""
        if len(self.headers.get(name, ())) > 1:
            raise Refusal("IncompleteSignature", f"header {name} was sent more than once; send it once")
        return self.first(name)

    def check_browser(self, loopback_only: bool) -> None:
        """Refuse requests that a web page of another site could have made a browser send: another Host, a foreign Origin."""
        host = self.single("host") or ""
        if loopback_only and not is_loopback(_split(f"//{host}").hostname or ""):
            raise Refusal(
                "AccessDeniedException",
                f"host {host!r} is not this machine's loopback address; use http://127.0.0.1, or give the server a token or key",
            )
        origin = self.single("origin")
        if origin and _split(origin).netloc.lower() != host.lower():
            raise Refusal("AccessDeniedException", f"requests from other web pages are refused (Origin {origin!r})")
        # a browser sends no Origin with what it only reads, such as an image; a link that a person follows is no such request
        site, target = self.single("sec-fetch-site"), (self.first("sec-fetch-mode"), self.first("sec-fetch-dest"))
        if site in ("cross-site", "same-site") and not (self.method == "GET" and target == ("navigate", "document")):
            raise Refusal("AccessDeniedException", f"requests from other web pages are refused (Sec-Fetch-Site {site})")


def _split(url: str) -> SplitResult:
    """The parts of an address; empty ones where it is malformed."""
    try:
        return urlsplit(url)
    except ValueError:
        return urlsplit("")


def is_loopback(host: str) -> bool:
    """Whether this name or address can mean only this machine."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class AuthorizationHeader:
    """An Authorization header of Signature Version 4: which key, at what time, signed which headers."""

    access_key_id: str
    date: str
    region: str
    service: str
    signed: tuple[str, ...]
    signature: str

    @classmethod
    def parse(cls, credentials: str) -> AuthorizationHeader:
        """The fields after the algorithm's name in the header. Raises Refusal."""
        parts: dict[str, str] = {}
        for part in credentials.split(","):
            name, _, value = part.strip().partition("=")
            parts[name] = value
        for name in ("Credential", "SignedHeaders", "Signature"):
            if not parts.get(name):
                raise Refusal("IncompleteSignature", f"Authorization header requires {name!r} parameter")
        scope = parts["Credential"].split("/")
        if len(scope) != 5 or scope[4] != "aws4_request" or scope[3] not in elsewhere.OURS:
            raise Refusal(
                "IncompleteSignature",
                f"Credential {parts['Credential'][:160]!r}: expected KEY/DATE/REGION/SERVICE/aws4_request with service "
                f"{' or '.join(elsewhere.OURS)}",
            )
        signed = tuple(sorted(set(parts["SignedHeaders"].lower().split(";"))))
        return cls(scope[0], scope[1], scope[2], scope[3], signed, parts["Signature"])

    def check(self, request: _Request, now: datetime) -> None:
        """Checks that need no secret: all required headers are signed, and the time is current. Raises Refusal."""
        for name in ("host", *(name for name in request.headers if name.startswith("x-amz-"))):
            if name not in self.signed:
                raise Refusal(
                    "InvalidSignatureException", f"header {name} is not signed; sign host and every x-amz-* header"
                )
        for name in self.signed:
            if name not in request.headers:
                raise Refusal("InvalidSignatureException", f"header {name[:80]!r} is signed but was not sent")
        time = request.single("x-amz-date") or ""
        try:
            if not re.fullmatch(r"[0-9]{8}T[0-9]{6}Z", time):
                raise ValueError
            skew = (datetime.strptime(time, "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC) - now).total_seconds()
        except ValueError:
            raise Refusal(
                "IncompleteSignature",
                f"header x-amz-date is {time[:80]!r}; it must be the time of signing, such as 20260131T235959Z",
            ) from None
        if abs(skew) > SKEW:
            raise Refusal(
                "RequestExpired",
                f"Signature expired: the request was signed at {time} and the server's clock says {now:%Y%m%dT%H%M%SZ}; "
                f"they may differ by {SKEW // 60} minutes, so set the client's clock",
            )
        if time[:8] != self.date:
            raise Refusal(
                "InvalidSignatureException", f"the credential is scoped to {self.date!r}, not to the day of {time}"
            )

    def check_signature(self, request: _Request, secret: str, body: bytes) -> None:
        """Make the signature again and compare. Raises Refusal."""
        digest = sha256(body).hexdigest()
        told = request.single("x-amz-content-sha256")
        if told is not None and told.lower() != digest:
            raise Refusal(
                "InvalidSignatureException",
                f"x-amz-content-sha256 is {told[:80]!r}, which is not the SHA-256 of the body; the body must be signed",
            )
        canonical = _canonical_request(request, self.signed, told or digest)
        scope = f"{self.date}/{self.region}/{self.service}/aws4_request"
        text = f"{_ALGORITHM}\n{request.first('x-amz-date')}\n{scope}\n{sha256(canonical).hexdigest()}"
        key = f"AWS4{secret}".encode()
        for part in (self.date, self.region, self.service, "aws4_request", text):
            key = hmac.digest(key, part.encode("latin-1"), "sha256")
        if not hmac.compare_digest(key.hex().encode(), self.signature.encode()):
            raise Refusal(
                "InvalidSignatureException",
                "The request signature we calculated does not match the signature you provided. Check your AWS Secret Access "
                f"Key and signing method (key {self.access_key_id})",
            )


def _canonical_request(request: _Request, signed: tuple[str, ...], payload: str) -> bytes:
    """The request in the form that is signed: the path as it was sent, encoded once more; no empty and no dot segments."""
    segments: list[bytes] = []
    for segment in request.raw_path.split(b"/"):
        if segment == b"..":
            del segments[-1:]
        elif segment not in (b"", b"."):
            segments.append(segment)
    last = b"/" if segments and request.raw_path.endswith(b"/") else b""
    pairs = sorted(pair.partition(b"=")[::2] for pair in request.query.split(b"&")) if request.query else []
    lines = [
        request.method.encode(),
        quote(b"/" + b"/".join(segments) + last, safe="/~").encode(),
        b"&".join(name + b"=" + value for name, value in pairs),
    ]
    for name in signed:
        values = b",".join(b" ".join(value.split()) for value in request.headers[name])
        lines.append(name.encode("latin-1") + b":" + values)
    return b"\n".join([*lines, b"", ";".join(signed).encode("latin-1"), payload.encode("latin-1")])


def session_of(headers: Mapping[str, str], port: int | None) -> str:
    """The console's session in the cookie of a request to this port; empty where there is none."""
    return cookie_parser(headers.get("cookie", "")).get(cookie_name(port), "")


def cookie_name(port: int | None) -> str:
    """Browsers send a cookie to every port of a host, where other controllers may listen."""
    return f"muster-session-{port}"


def _refused(request: _Request, refusal: ClientError) -> Response:
    """The refusal; a person's browser without a session is sent to the login instead."""
    wanted = request.first("accept") or ""
    if request.method in ("GET", "HEAD") and "text/html" in wanted and kind_of(refusal) in _UNKNOWN:
        there = request.raw_path.decode("latin-1") + ("?" + request.query.decode("latin-1") if request.query else "")
        return RedirectResponse(f"{LOGIN}?next={quote(there, safe='')}", 303)
    return error_response(str(refusal), refusal.status, kind_of(refusal))


def kind_of(error: RequestError) -> str:
    """AWS's name of an error."""
    return error.kind if isinstance(error, Refusal) else "ClientException"


def _with_request_id(send: Send) -> Send:
    """Every answer has the id that AWS's have; some clients read it unasked."""

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
