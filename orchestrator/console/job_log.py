"""The log of a job in a page: windows of it, results of a search, and new lines; never the whole."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Annotated, Any

from fastapi import Depends, Query, Request

from orchestrator.api.http.answer_streams import PIECE
from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native.log_stream import positions_of
from orchestrator.api.native.routes import permitted_job
from orchestrator.console.live import ServerSentEvent
from orchestrator.console.routing import page_router
from orchestrator.control.log_hub import LogHub
from orchestrator.services.permissions import Operation
from shared_store.volume.log_view import Chosen, LogView, Places
from shared_store.volume.log_windows import LINES_A_WINDOW, Window, first_error, lines_after, lines_before, search
from shared_store.volume.logs import LogLine

router = page_router(stored=True)

_MOST_LAG = 1 << 20
"""Bytes that a page gets of the lines that it has missed; where it has missed more, it gets the last lines alone."""
_LONGEST = 4000
"""Characters of a line that a page shows."""
_AROUND = 30
"""Lines after one that was found."""


def chosen_log(
    request: Request,
    reference: str,
    node: Annotated[str, Query(max_length=10, pattern="^[0-9]*$")] = "",
    rank: Annotated[str, Query(max_length=10, pattern="^[0-9]*$")] = "",
    attempt: Annotated[str, Query(max_length=10, pattern="^[0-9]*$")] = "",
) -> Chosen:
    """The lines of the job that are requested; empty numbers mean all. Raises ClientError."""
    controller, actor = controller_of(request), actor_of(request)
    with controller.database.session() as session:
        job = permitted_job(session, actor, reference, Operation.READ_JOB_LOGS)
        run, job_id = controller.access.store.run(job.run), job.id
    numbers = (int(each) if each else None for each in (node, rank, attempt))
    return Chosen(run, job_id, *numbers)


ChosenLog = Annotated[Chosen, Depends(chosen_log)]


@router.get("/jobs/{reference}/log")
def window(
    chosen: ChosenLog,
    before: str = Query(default="", max_length=50_000),
    after: str = Query(default="", max_length=50_000),
    around: str = Query(default="", max_length=50_000),
) -> dict[str, Any]:
    """A window of the log: its last lines, the lines before or after a place, or those around the line that ends at a place."""
    if after:
        return _written(lines_after(chosen, positions_of(after)))
    if around:
        end = lines_after(chosen, positions_of(around), _AROUND).last
        return _written(lines_before(chosen, end, LINES_A_WINDOW))
    return _written(lines_before(chosen, positions_of(before) if before else chosen.end()))


@router.get("/jobs/{reference}/log/search")
def find(
    chosen: ChosenLog,
    text: str = Query(default="", max_length=200),
    place: str = Query(default="{}", max_length=50_000),
) -> dict[str, Any]:
    """Lines with a text, or the first errors where there is none; ``over`` is false where the search continues at ``place``."""
    start = positions_of(place)
    found = search(chosen, text, start) if text else first_error(chosen, start)
    ends = {"positions": [each.position for each in found.lines]}
    return {"lines": written(found.lines), **ends, "place": found.place, "over": found.is_over}


def _written(found: Window) -> dict[str, Any]:
    return {"lines": written(found.lines), "first": found.first, "last": found.last, "more": found.more}


def written(lines: Sequence[LogLine]) -> list[list[Any]]:
    """Time, attempt, node, rank (None: the supervisor), stream and text of each line."""
    return [[*line[:5], line.text if len(line.text) <= _LONGEST else f"{line.text[:_LONGEST]} …"] for line in lines]


class LiveLog(AbstractContextManager["LiveLog"]):
    """The lines of a log that are new to one page, while its block runs."""

    def __init__(self, hub: LogHub, chosen: Chosen, places: Places) -> None:
        """``places``: the positions up to which the page has the lines."""
        self.chosen, self.places = chosen, places
        self._view = LogView(chosen, dict(places), PIECE)
        self._following = hub.follow(chosen.run, chosen.job, self)

    def __enter__(self) -> LiveLog:
        self._logs = self._following.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._following.__exit__(*error)

    def wake(self) -> None:
        """The page polls at intervals anyway."""

    def changes(self, is_last: bool) -> tuple[ServerSentEvent | None, bool]:
        """The event ``lines`` or ``window``, and whether there is more already; ``is_last``: the job is over, so that the files have all.

        ``window``: the page has missed so much that it gets the last lines alone; ``skipped`` are the bytes before them. Raises OSError.
        """
        lines = None if is_last else self._view.poll_memory(self._logs, PIECE)
        if lines is None:
            end = self.chosen.end()
            lag = sum(max(0, position - self.places.get(key, 0)) for key, position in end.items())
            if lag > _MOST_LAG:
                last = lines_before(self.chosen, end)
                skipped = sum(max(0, last.first.get(key, 0) - self.places.get(key, 0)) for key in end)
                self._view, self.places = LogView(self.chosen, dict(end), PIECE), dict(end)
                return ServerSentEvent("window", {**_written(last), "skipped": skipped}), False
            lines = self._view.poll()
        self.places = dict(self._view.offsets)
        event = ServerSentEvent("lines", {"lines": written(lines), "last": self.places})
        return event if lines else None, self._view.behind
