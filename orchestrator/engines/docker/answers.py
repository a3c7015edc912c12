"""The message about a Docker Engine that does not answer, and the decision to wait for it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import requests
import urllib3
from docker.errors import APIError

from orchestrator.engines.api import EngineError, NotYet


@contextmanager
def answered() -> Iterator[None]:
    """Around calls of Docker's client, all of whose errors are OSErrors, as those of the store are.

    Raises:
        NotYet: Docker Engine is not reached, or can't answer (5xx).
        EngineError: It refuses, in its own words.
    """
    try:
        yield
    except APIError as error:
        words = " ".join((error.explanation or str(error)).split())
        if not error.is_server_error():
            raise EngineError(f"Docker Engine refuses: {words}") from error
        why = f"Docker Engine has no answer ({words}); see its log (journalctl -u docker)"
        raise NotYet(why, unknown=True) from error
    except (requests.RequestException, urllib3.exceptions.HTTPError) as error:
        raise NotYet(unanswered(error), unknown=True) from error


def unanswered(error: BaseException) -> str:
    """That no Docker Engine answers, why, and what to do: in one line."""
    return f"no Docker Engine answers ({_cause(error)}); start it (systemctl start docker), or set DOCKER_HOST"


def _cause(error: BaseException) -> str:
    """The operating system's words, which Docker's client, requests and urllib3 each wrap; else those of the outermost."""
    words, inner = " ".join(str(error).split()), error.__cause__ or error.__context__
    while inner is not None:
        if isinstance(inner, OSError) and not isinstance(inner, requests.RequestException):
            words = inner.strerror or str(inner) or words
        inner = inner.__cause__ or inner.__context__
    return words
