"""A person at a real browser: Chromium without a display, by Playwright. What the pages ask for and complain about is recorded."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, ConsoleMessage, Page, Request, ViewportSize, expect

from tests.conftest import REPOSITORY
from tests.support.waiting import PATIENCE

PICTURES = REPOSITORY / "build" / "console"
"""The pictures of the pages that the tests saw."""
WIDE: ViewportSize = {"width": 1280, "height": 800}
PHONE: ViewportSize = {"width": 390, "height": 844}
WAIT = 20_000 * PATIENCE
"""The longest that the browser waits for anything [ms]."""
_EXPECTED = re.compile(
    r"Failed to load resource: (net::ERR_|the server responded with a status of 4)|ERR_INCOMPLETE_CHUNKED"
)
"""What the browser itself says of a server that is away, or that refused something: the pages handle both."""


class Person:
    """One person at one server, with cookies of their own.

    Args:
        key: ``ACCESS_KEY_ID:SECRET``, to log in with; none where the server asks for none.
    """

    def __init__(self, browser: Browser, url: str, key: str = "", **context: Any) -> None:
        self.url, self.requested, self.complaints = url, list[str](), list[str]()
        self._context = browser.new_context(base_url=url, **{"viewport": WIDE, **context})
        self._context.set_default_timeout(WAIT)
        self._context.on("request", self._on_request)
        self.page: Page = self._context.new_page()
        self.page.on("console", self._on_console)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("dialog", lambda dialog: self.complaints.append(f"a script asks: {dialog.message}"))
        if key:
            self.page.goto("/login")
            self.page.get_by_label("Key, as").fill(key)
            self.page.get_by_role("button", name="Log in").click()
            expect(self.page.get_by_role("button", name="Log out")).to_be_visible()

    def _on_request(self, request: Request) -> None:
        self.requested.append(request.url)

    def _on_console(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning") and not _EXPECTED.search(message.text):
            self.complaints.append(f"{message.type}: {message.text} ({message.location.get('url')})")

    def goto(self, path: str) -> Page:
        self.page.goto(path)
        return self.page

    def click(self, name: str) -> None:
        """A button or a link of the page's content, by its words."""
        content = self.page.get_by_role("main")
        content.get_by_role("button", name=name, exact=True).or_(
            content.get_by_role("link", name=name, exact=True)
        ).click()

    def leave(self, name: str) -> None:
        """Click, and wait for the other page that this leads to."""
        before = self.page.url
        self.click(name)
        self.page.wait_for_url(lambda url: url != before)

    def confirm(self) -> None:
        """Say yes to the question that the page asks. The yes is sent after the click: leaving the page before its answer could lose it."""
        dialog = self.page.get_by_role("dialog")
        expect(dialog).to_be_visible()
        with self.page.expect_response(lambda answer: answer.request.method == "POST"):
            dialog.locator("button.danger").click()
        expect(dialog).to_be_hidden()

    def picture(self, name: str) -> Path:
        """Keep how the page looks."""
        PICTURES.mkdir(parents=True, exist_ok=True)
        path = PICTURES / f"{name}.png"
        self.page.screenshot(path=path)
        return path

    @property
    def elsewhere(self) -> list[str]:
        """What the pages asked of anybody but the server."""
        return [each for each in self.requested if not each.startswith((f"{self.url}/", "data:"))]


class People:
    """Who is at the browser; in the end none of them may have seen a page that complains or sends a request elsewhere."""

    def __init__(self, browser: Browser) -> None:
        self._browser, self._all = browser, list[Person]()

    def __call__(self, url: str, key: str = "", **context: Any) -> Person:
        self._all.append(Person(self._browser, url, key, **context))
        return self._all[-1]

    def check(self) -> None:
        """Raises AssertionError: a page broke its Content-Security-Policy, a script failed, or something came from elsewhere."""
        for each in self._all:
            assert each.requested and each.elsewhere == []
            assert each.complaints == []
