"""The system's Chromium, without a display."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

_DRAWING = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


@contextmanager
def launched(*arguments: str) -> Iterator[Browser]:
    """A browser for one test: asked to close a page that is loading, it sometimes never answers, and only a whole browser that doesn't is
    killed (by Playwright, after 30 s). Skips the test where Chromium is not installed.
    """
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("CHROMIUM IS NOT INSTALLED (apt-get install chromium): THE PAGE HAS NOT BEEN LOOKED AT")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", *arguments])
        yield browser
        browser.close()


@contextmanager
def empty_page() -> Iterator[Page]:
    """A page of 640 x 400 in a browser that draws in three dimensions, on the processor."""
    with launched(*_DRAWING) as browser:
        yield browser.new_page(viewport={"width": 640, "height": 400})


def picture(page: Page) -> np.ndarray:
    """What is seen, shape ``(height, width, 3)``, uint8."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot(timeout=120_000))).convert("RGB"))
