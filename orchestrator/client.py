"""The HTTP client that the command uses, and that a Python program may use.

>>> client = Client.connect()
>>> client.batch("ListJobs", jobQueue="default", filters=[{"name": "JOB_NAME", "values": ["ant*"]}])
"""

from __future__ import annotations

import json
import os
import re
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.parse import quote, urlsplit

import httpx

from orchestrator.domain.errors import ApiError, NotServing, NoUrl, Unreachable
from orchestrator.domain.job import TERMINAL
from orchestrator.home import local_socket, muster_home, published
from shared_store.volume.texts import digest_of

EXAMPLE_URL = "http://127.0.0.1:8080"

_PAUSES = (0.2, 0.4, 0.8, 1.6, 0)
"""Seconds after each refusal for too many requests or connections; the last refusal is reported."""
_MOST_EMPTY = 4
"""Streams in a row that broke off without a line, after which those of a job that is over are given up."""
_LONGEST_PAUSE = 5.0
"""Seconds between two streams that brought no line."""


def _unnamable(text: str) -> ApiError:
    return ApiError(f"{text!r} names nothing; jobs and runs are named with letters, digits, '.', '_' and '-'", 400)


def named(name: str) -> str:
    """The name of a job or a run, as a part of a path. Raises ApiError where nothing can be called so."""
    if not re.fullmatch(r"[A-Za-z0-9_.:#-]{1,256}", name) or name in (".", ".."):
        raise _unnamable(name)
    return quote(name, safe=":")


def _is_url(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # of a port that there can't be
        return False


class Client:
    """Requests to one controller."""

    def __init__(self, url: str, token: str | None = None, socket: Path | None = None) -> None:
        """Raises NoUrl where ``url`` is malformed. ``socket``: a Unix socket of the controller, which is used in place of TCP."""
        if not _is_url(url):
            raise NoUrl(
                f"{url!r} is not the URL of a controller; set --server or MUSTER_URL to one such as {EXAMPLE_URL}"
            )
        self.url = url
        self.found = False
        """Whether it is the running controller of the home directory, which no URL named."""
        self.is_temporary = False
        """Whether it goes away with the command that started it, which may be any moment."""
        self.successor: Callable[[], Client] | None = None
        """Finds or starts another controller when this one is gone; None: the client waits for this one."""
        self.notify: Callable[[str], object] = lambda line: None
        """Is called with what a person would like to know while nothing happens."""
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        transport = httpx.HTTPTransport(uds=str(socket), verify=False) if socket else None  # it has no TLS to verify
        self._http = httpx.Client(base_url=url, headers=headers, timeout=30, trust_env=False, transport=transport)

    @classmethod
    def connect(cls, url: str | None = None, *, serving: bool = False) -> Client:
        """The controller at ``url``, else at ``$MUSTER_URL``, else that of ``$MUSTER_HOME``.

        Another home directory's controller is never taken in its place: names of jobs and runs are the same everywhere.

        Raises:
            Unreachable: None answers.
            NotServing: It answers that it can't serve now, and ``serving`` is set; without its store it can still list and stop jobs.
            ApiError: The token is refused.
        """
        home, url = muster_home(), url or os.environ.get("MUSTER_URL")
        here, found = published(home), url is None
        if url is None:
            if here is None:
                raise Unreachable(
                    f"no controller of {home} runs; start one with `muster serve`, or set MUSTER_URL to that of another one, "
                    f"such as {EXAMPLE_URL}"
                )
            url = here.url
        is_here = here is not None and here.url == url
        client = cls(url, os.environ.get("MUSTER_TOKEN"), local_socket(home) if is_here else None)
        client.found, client.is_temporary = found, found and here is not None and here.temporary
        try:
            client.get("/healthz")
        except NotServing:
            if serving:
                raise
        return client

    def batch(self, operation: str, **request: Any) -> dict[str, Any]:
        """An AWS Batch operation, such as ``SubmitJob``, with its members as keywords. Raises ApiError, Unreachable."""
        answer: dict[str, Any] = self._answer(
            "POST", f"/v1/{operation.lower()}", request, once=operation == "SubmitJob"
        ).json()
        return answer

    def get(self, path: str, *, seconds: float = 30, **query: Any) -> Any:
        """GET of a native path, waiting up to ``seconds`` for the answer. Raises ApiError, Unreachable."""
        known = {key: value for key, value in query.items() if value is not None}
        return self._answer("GET", path, query=known, seconds=seconds).json()

    def post(self, path: str, body: dict[str, Any], *, seconds: float = 30, once: bool = False) -> Any:
        """POST to a native path, waiting up to ``seconds`` for the answer. Raises ApiError, Unreachable.

        ``once``: it submits a job, and is sent again under the same idempotency key where the answer was lost.
        """
        return self._answer("POST", path, body, seconds=seconds, once=once).json()

    def delete(self, path: str, *, seconds: float = 30) -> Any:
        """DELETE of a native path, waiting up to ``seconds`` for the answer. Raises ApiError, Unreachable."""
        return self._answer("DELETE", path, seconds=seconds).json()

    def run_text(self, run: str, sha256: str) -> str | None:
        """A long text of a run's jobs; None where the run has it not. Raises ApiError, Unreachable."""
        try:
            return self._answer("GET", f"/api/runs/{named(run)}/texts/{sha256}").text
        except ApiError as error:
            if error.status == 404:
                return None
            raise

    def keep_text(self, text: str) -> None:
        """Have the store keep a long text for a job that names it by its SHA-256; again does no harm. Raises ApiError, Unreachable."""
        self._answer("PUT", f"/api/texts/{digest_of(text)}", content=text.encode())

    def logs(self, job: str, **query: Any) -> Iterator[dict[str, Any]]:
        """The job's log lines. Raises ApiError, Unreachable.

        With ``follow=True`` until the job is over: a controller that goes away is waited for, and its successor's stream is taken
        up where this one broke off, no line twice and none left out. Streams that break off without a line, again and again, end
        it when the job is over.
        """
        for lines in self.log_batches(job, **query):
            yield from lines

    def log_batches(self, job: str, **query: Any) -> Iterator[list[dict[str, Any]]]:
        """:meth:`logs`, as many lines at a time as have come: none where none have come for some seconds."""
        positions: dict[str, int] = {}
        empty = 0
        while True:
            before, broken = dict(positions), None
            try:
                for lines in self._stream(job, query, positions):
                    for line in lines:
                        positions[f"{line['attempt']}/{line['node']}"] = line["position"]
                    yield lines
                if not query.get("follow") or self._is_over(job):
                    return  # else the controller was stopped, which ends its streams in order
            except Unreachable as error:
                if not query.get("follow"):
                    raise
                broken = error
            empty = empty + 1 if positions == before else 0
            if empty:
                time.sleep(min(0.1 * 2**empty, _LONGEST_PAUSE))
            self.await_return()
            if broken and empty >= _MOST_EMPTY and self._is_over(job):
                raise broken

    def _is_over(self, job: str) -> bool:
        return self.get(f"/api/jobs/{named(job)}")["status"] in TERMINAL

    def _stream(self, job: str, query: dict[str, Any], positions: dict[str, int]) -> Iterator[list[dict[str, Any]]]:
        parameters = {key: value for key, value in query.items() if value is not None}
        if positions:
            parameters["positions"] = json.dumps(positions)
        try:
            with self._http.stream(
                "GET", f"/api/jobs/{named(job)}/logs", params=parameters, timeout=httpx.Timeout(30, read=60)
            ) as answer:
                if answer.is_error:
                    answer.read()
                    self._raise(answer)
                rest = b""
                for chunk in answer.iter_bytes():
                    whole, _, rest = (rest + chunk).rpartition(b"\n")
                    if lines := [line for line in whole.split(b"\n") if line]:  # an empty one: the stream lives
                        yield json.loads(b"[" + b",".join(lines) + b"]")
                    elif chunk == b"\n":
                        yield []
        except httpx.HTTPError as error:
            raise self._unreachable(error) from None
        except httpx.InvalidURL:
            raise _unnamable(job) from None

    def _answer(
        self,
        method: str,
        path: str,
        body: Any = None,
        query: dict[str, Any] | None = None,
        seconds: float = 30,
        content: bytes | None = None,
        once: bool = False,
    ) -> httpx.Response:
        """``body``: JSON; ``content``: a body as it is; ``once``: as of :meth:`post`."""
        headers = {"X-Muster-Idempotency-Key": uuid.uuid4().hex} if once else {}

        def send() -> httpx.Response:
            for pause in _PAUSES:
                answer = self._http.request(
                    method, path, json=body, content=content, params=query, timeout=seconds, headers=headers
                )
                if answer.status_code != 429 and not (answer.status_code == 503 and "retry-after" in answer.headers):
                    break
                time.sleep(pause)  # refused before anything was done
            return answer

        try:
            try:
                answer = send()
            except (httpx.ConnectError, httpx.ReadError, httpx.RemoteProtocolError) as error:
                is_gone = self.successor is not None and (method == "GET" or isinstance(error, httpx.ConnectError))
                if not (is_gone or (headers and not isinstance(error, httpx.ConnectError))):
                    raise
                # a request that was not sent, or changes nothing, or has its key and so submits nothing twice
                self.await_return(30, serving=False)
                answer = send()
        except httpx.HTTPError as error:
            raise self._unreachable(error) from None
        except httpx.InvalidURL:
            raise _unnamable(path) from None
        if answer.is_error:
            self._raise(answer)
        return answer

    @staticmethod
    def _raise(answer: httpx.Response) -> None:
        try:
            message = answer.json()["message"]
        except (ValueError, KeyError, TypeError):
            message = f"{answer.request.url} answered {answer.status_code}; is that a Muster controller?"
        if answer.status_code in (502, 504):
            raise Unreachable(
                f"the proxy at {answer.request.url.host} answers {answer.status_code}: its controller is away"
            )
        raise (NotServing if answer.status_code == 503 else ApiError)(message, answer.status_code)

    def _unreachable(self, error: httpx.HTTPError) -> Unreachable:
        return Unreachable(
            f"no controller answers at {self.url} ({error or type(error).__name__}); start one with `muster serve`"
        )

    def await_return(self, seconds: float = 120, *, serving: bool = True) -> None:
        """Wait until the controller, or its successor on the same home directory, answers again. Raises Unreachable.

        Args:
            seconds: For so long one is waited for that does not answer.
            serving: Wait, without end, until one that answers can serve again.
        """
        deadline, shown = time.monotonic() + seconds, ""
        while True:
            try:
                url = None if self.found else self.url
                successor = self.successor() if self.successor else Client.connect(url, serving=serving)
                break
            except NotServing as error:
                deadline, problem = time.monotonic() + seconds, f"{error}; waiting"
            except Unreachable:
                if time.monotonic() > deadline:
                    raise
                problem = f"no controller answers at {self.url}; waiting up to {seconds:.0f} s for one"
            if problem != shown:
                self.notify(problem)
                shown = problem
            time.sleep(0.5)
        self._http.close()
        self.url, self._http = successor.url, successor._http

    def close(self) -> None:
        self._http.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
