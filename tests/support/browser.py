"""Chromium without a display that draws in three dimensions, on the processor."""

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
    from playwright.sync_api import Page

_DRAWING = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


@contextmanager
def empty_page() -> Iterator[Page]:
    """A page of 640 x 400 in a browser of its own; skips the test where Chromium is not installed."""
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("Chromium is not installed (apt-get install chromium): the page has not been looked at")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox", *_DRAWING])
        yield browser.new_page(viewport={"width": 640, "height": 400})
        browser.close()


def picture(page: Page) -> np.ndarray:
    """What is seen, shape ``(height, width, 3)``, uint8."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot(timeout=120_000))).convert("RGB"))
