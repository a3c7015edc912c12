"""The head of a request: what its first line and its headers alone decide about it."""

from __future__ import annotations

import ipaddress
from urllib.parse import SplitResult, urlsplit

from starlette.datastructures import Headers
from starlette.types import Scope

from orchestrator.api.http import foreign_services
from orchestrator.services.permissions import BY_LOWER_NAME, Refusal

_LOGS_TARGET = "Logs_20140328."


class RequestHead:
    """The facts that decide about a request, from its first line and its headers alone."""

    def __init__(self, scope: Scope) -> None:
        self.headers = Headers(scope=scope)
        """By name in lower case; of one that was sent twice, the first counts, as in the application."""
        self.method: str = scope["method"]
        self.path: str = scope["path"]
        self.raw_path: bytes = scope["raw_path"]
        self.query: bytes = scope["query_string"]
        self.client: str = scope["client"][0] if scope.get("client") else "unknown"
        self.port: int | None = scope["server"][1] if scope.get("server") else None
        target = self.headers.get("x-amz-target", "")
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

    @property
    def is_of_console(self) -> bool:
        """Whether it is for the console, whose forms carry a token of their own, and not for an API."""
        return self.path != "/" and not self.path.startswith(("/v1/", "/api/"))

    @property
    def foreign_service(self) -> str | None:
        """The AWS service that the request is meant for, where it is none of ours."""
        return foreign_services.foreign_service(self.method, self.path, self.query, self.headers)

    def single(self, name: str) -> str | None:
        """A header that decides about access. Raises Refusal where it was sent twice: which one would count?"""
        if len(values := self.headers.getlist(name)) > 1:
            raise Refusal("IncompleteSignature", f"header {name} was sent more than once; send it once")
        return values[0] if values else None

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
        # a browser sends no Origin with what it only reads, such as an image; a link that a person follows is another request
        site, target = (
            self.single("sec-fetch-site"),
            (self.headers.get("sec-fetch-mode"), self.headers.get("sec-fetch-dest")),
        )
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
