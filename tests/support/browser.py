"""Chromium without a display, driven by its DevTools protocol: what a page asks for, and how it looks."""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from websockets.sync.client import connect

from tests.support.waiting import wait_for

_OPTIONS = (
    "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist --no-first-run "
    "--remote-debugging-port=0 --disable-background-networking --window-size=640,400"
)


class Browser:
    """A page in a browser of its own; skips the test where Chromium is not installed."""

    def __init__(self, url: str, home: Path) -> None:
        program = shutil.which("chromium")
        if program is None:
            pytest.skip("Chromium is not installed (apt-get install chromium): the page has not been looked at")
        command = [program, *_OPTIONS.split(), f"--user-data-dir={home}", "about:blank"]
        self._process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert self._process.stderr is not None
        listening = next(line for line in self._process.stderr if "DevTools listening" in line)
        with urllib.request.urlopen(f"http://{listening.split('ws://')[1].split('/')[0]}/json") as pages:
            own = next(each for each in json.load(pages) if each["type"] == "page")
        self._open = ExitStack()
        self._socket = self._open.enter_context(connect(own["webSocketDebuggerUrl"], max_size=1 << 28))
        self._sent = 0
        self.asked: set[str] = set()
        """All that the page asked for."""
        for domain in ("Network", "Page"):
            self.call(f"{domain}.enable")
        self.call("Page.navigate", url=url)

    def picture(self) -> np.ndarray:
        """What is seen, shape ``(height, width, 3)``, uint8."""
        answer = wait_for(self._shot, 30, "a picture of the page")
        data = base64.b64decode(answer["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def _shot(self) -> dict[str, Any] | None:
        """A picture; None while the browser goes to the page and has none."""
        try:
            return self.call("Page.captureScreenshot", format="png")
        except RuntimeError:
            return None

    def close(self) -> None:
        self._open.close()
        self._process.terminate()
        self._process.wait()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A command of the DevTools protocol. Raises RuntimeError where the browser refuses it."""
        self._sent += 1
        self._socket.send(json.dumps({"id": self._sent, "method": method, "params": parameters}))
        while True:
            got = json.loads(self._socket.recv(timeout=120))
            if got.get("method") == "Network.requestWillBeSent":
                self.asked.add(got["params"]["request"]["url"])
            if got.get("id") == self._sent:
                if "error" in got:
                    raise RuntimeError(f"{method}: {got['error']}")
                result: dict[str, Any] = got["result"]
                return result
