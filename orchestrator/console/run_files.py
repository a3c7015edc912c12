"""The files that a run has made: pictures, recordings, evaluations, exported policies. Listed, shown and downloaded."""

from __future__ import annotations

import mimetypes
import os
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from urllib.parse import quote

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.console.routing import page_router
from orchestrator.domain.errors import ClientError
from orchestrator.services.context import permitted_run
from orchestrator.services.permissions import Operation
from shared_store.volume.files import DamagedFile, open_inside
from shared_store.volume.layout import NAME, Run

router = page_router(stored=True)

PLACES = ("metrics", "recordings", "evaluations", "exports")
"""Directories of a run whose files are shown."""
_MOST = 200
_MOST_READ = 2000
"""Greatest number of entries that are read of a directory: a job may make any number of them."""
_DEEPEST = 4
_PICTURES = (".png", ".gif")
_BLOCK = 256 << 10


@dataclass(frozen=True)
class File:
    """A file of a run, by its path in it."""

    path: str
    size: int
    """Bytes."""
    changed: int
    """Unix time [ms]."""
    address: str

    @property
    def is_picture(self) -> bool:
        return self.path.endswith(_PICTURES)


def files_of(run: Run) -> list[File]:
    """The first 200 files of each place, the newest first. Raises DamagedFile, OSError."""
    run.check_links()
    return [each for place in PLACES for each in _in(run, place)]


def _in(run: Run, place: str) -> list[File]:
    found = [(path, path.stat(follow_symlinks=False)) for path in _walk(run.path / place, 1)]
    found.sort(key=lambda each: each[1].st_mtime, reverse=True)
    files = []
    for path, facts in [each for each in found if each[1].st_size][:_MOST]:
        name = path.relative_to(run.path).as_posix()
        files.append(File(name, facts.st_size, int(facts.st_mtime * 1000), f"/runs/{run.name}/files/{quote(name)}"))
    return files


def _walk(directory: Path, depth: int) -> Iterator[Path]:
    try:
        with os.scandir(directory) as entries:
            found = sorted(islice(entries, _MOST_READ), key=lambda each: each.name)
    except (FileNotFoundError, NotADirectoryError):
        return
    for entry in found:
        if not NAME.fullmatch(entry.name):
            continue  # hidden, or of no use as an address
        if entry.is_file(follow_symlinks=False):
            yield Path(entry.path)
        elif entry.is_dir(follow_symlinks=False) and depth < _DEEPEST:
            yield from _walk(Path(entry.path), depth + 1)


@router.get("/runs/{name}/files/{path:path}")
def file(request: Request, name: str, path: str) -> Response:
    """A file of a run: pictures are shown, other files are downloaded."""
    controller, actor = controller_of(request), actor_of(request)
    run = permitted_run(controller, actor, name, Operation.READ_RUN)
    parts = path.split("/")
    if parts[0] not in PLACES or len(parts) > _DEEPEST + 1 or not all(map(NAME.fullmatch, parts)):
        raise ClientError(f"run {run.name} shows no file {path[:100]!r}", 404)
    try:
        opened = open_inside(run.path, parts)
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        raise ClientError(f"run {run.name} has no file {path[:100]!r}", 404) from None
    except (DamagedFile, OSError) as error:
        raise ClientError(f"{path[:100]} of run {run.name} can't be read: {error}", 409) from None
    size = os.fstat(opened.fileno()).st_size

    async def blocks() -> AsyncIterator[bytes]:
        left = size  # a file that grows meanwhile has no more than was announced
        try:
            while left and (block := await controller.access.calls.answer(partial(opened.read, min(left, _BLOCK)))):
                left -= len(block)
                yield block
        finally:
            controller.access.calls.later(opened.close)  # waits for a read that hangs

    is_picture = path.endswith(_PICTURES)
    headers = {
        "Content-Length": str(size),
        "Content-Disposition": "inline" if is_picture else f'attachment; filename="{parts[-1]}"',
        "Content-Security-Policy": "default-src 'none'; sandbox",
        "Cache-Control": "no-store",
        "Cross-Origin-Resource-Policy": "same-origin",
    }
    kind = mimetypes.guess_type(path)[0] if is_picture else None
    return StreamingResponse(blocks(), media_type=kind or "application/octet-stream", headers=headers)
