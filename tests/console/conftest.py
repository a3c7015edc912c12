"""The browser of this tier's tests."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect, sync_playwright

from tests.support.console.person import WAIT, People


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    """The system's Chromium."""
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("CHROMIUM IS NOT INSTALLED (apt-get install chromium): NO PAGE OF THE CONSOLE HAS BEEN LOOKED AT")
    expect.set_options(timeout=WAIT)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def people(chromium: Browser) -> Iterator[People]:
    """Opens browsers of persons: ``people(url, key)``. In the end none of their pages may have complained or asked anybody else."""
    people = People(chromium)
    yield people
    people.close()
    people.check()
