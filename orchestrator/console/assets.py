"""The console's assets: scripts and styles under an address that changes with their content, so that browsers cache them for ever."""

from __future__ import annotations

import mimetypes
from functools import cache
from hashlib import sha256
from pathlib import Path

from fastapi import APIRouter, Response

from orchestrator.domain.errors import ClientError

router = APIRouter(include_in_schema=False)
_FOLDER = Path(__file__).parent / "static"
mimetypes.add_type("text/javascript", ".js")


@cache
def _files() -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(_FOLDER.iterdir()) if path.is_file()}


@cache
def version() -> str:
    """One version for all files: a module imports its neighbours by their plain names, and gets those of its own version."""
    whole = sha256()
    for name, content in _files().items():
        whole.update(f"{name}\0{len(content)}\0".encode() + content)
    return whole.hexdigest()[:16]


def url(name: str) -> str:
    """The address of a file in ``static/``. Raises KeyError for an unknown file."""
    _ = _files()[name]
    return f"/static/{version()}/{name}"


@router.get("/static/{of}/{name}")
def file(of: str, name: str) -> Response:
    """A file. An old page may ask for another version than this server's: it gets the present file, which browsers must not cache."""
    content = _files().get(name)
    if content is None:
        raise ClientError(f"there is no file {name[:100]!r}", 404)
    age = "public, max-age=31536000, immutable" if of == version() else "no-store"
    headers = {"Cache-Control": age, "Cross-Origin-Resource-Policy": "same-origin"}
    return Response(content, media_type=mimetypes.guess_type(name)[0] or "application/octet-stream", headers=headers)
