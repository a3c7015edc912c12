"""A person's browser without its scripts: keeps cookies, follows links, sends the forms of the page that it has."""

from __future__ import annotations

import json
from collections.abc import Iterator
from html.parser import HTMLParser
from typing import Any

import httpx

from tests.support.waiting import PATIENCE


class Page(HTMLParser):
    """The parts of a page that a test asks about."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.source, self.words = text, list[str]()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.words += data.split()

    @property
    def text(self) -> str:
        """What is read, with single spaces."""
        return " ".join(self.words)

    def all(self, tag: str, **attributes: str) -> list[dict[str, str | None]]:
        """The attributes of every element of this tag that has these."""
        return [each for name, each in self.elements if name == tag and attributes.items() <= each.items()]

    @property
    def is_inert(self) -> bool:
        """Whether it has no script but its files, no style of its own, no handler in an attribute and nothing from elsewhere."""
        for tag, attributes in self.elements:
            if tag in ("style", "iframe", "object", "embed", "base") or (tag == "script" and "src" not in attributes):
                return False
            if any(name == "style" or name.startswith("on") for name in attributes):
                return False
            supplied = [
                attributes[name] or "/" for name in ("src", "href", "action", "data-live") if name in attributes
            ]
            if any(not each.startswith(("/", "#")) or each.startswith("//") for each in supplied):
                return False
        return True

    @property
    def form_token(self) -> str:
        (meta,) = self.all("meta", name="form-token")
        return str(meta["content"])


class Visitor:
    """One person at one server."""

    def __init__(self, url: str, key: str = "") -> None:
        """``key``: ``ACCESS_KEY_ID:SECRET`` or the server's token, to log in with; none where the server asks for none."""
        headers = {"Accept": "text/html"}
        self.http = httpx.Client(
            base_url=url, timeout=30 * PATIENCE, headers=headers, follow_redirects=True, trust_env=False
        )
        if key:
            answer = self.http.post("/login", data={"key": key, "next": "/"})
            assert answer.status_code == 200, answer.text

    def page(self, path: str, status: int = 200) -> Page:
        """The page at a path, as the person reads it."""
        answer = self.http.get(path)
        assert answer.status_code == status, answer.text
        return Page(answer.text)

    def submit(self, path: str, **fields: Any) -> httpx.Response:
        """Send a form, as a script would: the answer is JSON."""
        data = {"form_token": self.page("/").form_token, **fields}
        return self.http.post(path, data=data, headers={"Accept": "application/json"})

    def refusal(self, path: str, status: int = 403, **fields: Any) -> str:
        """The message to a person whose form is refused with this status."""
        answer = self.submit(path, **fields)
        assert answer.status_code == status, answer.text
        return str(answer.json()["message"])

    def events(self, path: str, **headers: str) -> Iterator[tuple[str, Any, str]]:
        """Name, data and id of the events of a stream, as they come, until the caller leaves."""
        supplied = {"Accept": "text/event-stream", **headers}
        with self.http.stream("GET", path, headers=supplied) as answer:
            assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/event-stream")
            result: dict[str, str] = {}
            for line in answer.iter_lines():
                name, _, value = line.partition(": ")
                if not line and "data" in result:
                    yield result.get("event", "message"), json.loads(result["data"]), result.get("id", "")
                result = {**result, name: value} if line else {}

    def close(self) -> None:
        self.http.close()
