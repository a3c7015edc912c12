"""The page of the live view: Rerun's server in a process of its own, and its web viewer, on loopback and without calls to the internet.

Rerun's own page asks fonts.googleapis.com for a font, and the viewer in it asks api.github.com and tel.rerun.io. The page is therefore
served from here, with a Content-Security-Policy that lets the browser reach nothing but this page and Rerun's server.
"""

from __future__ import annotations

import http.client
import json
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlencode, urlsplit

from shared_store.process.tether import tied
from worker.settings.errors import UserError

LOOPBACK = "127.0.0.1"
PORTS = range(9090, 9100)
"""Of the page: the first free one, where no other is asked for."""
_RELAYED = ("Accept", "Content-Type", "X-Grpc-Web", "X-User-Agent", "Grpc-Timeout")
"""Headers of a request for the stream that Rerun's server gets."""
_STARTED_WITHIN = 30.0
"""Seconds in which Rerun's server answers."""
_ASSETS = {
    "/re_viewer.js": "text/javascript",
    "/re_viewer_bg.wasm": "application/wasm",
    "/favicon.ico": "image/x-icon",
    "/apple-touch-icon.png": "image/png",
}
_LARGEST_REQUEST = 1 << 20
"""Bytes; a page asks, and sends nothing of a recording."""
_DIRECT = urllib.request.build_opener(urllib.request.ProxyHandler({}))
"""Asks this machine, whatever proxy the environment names."""
_ELSEWHERE = re.compile(r"<link\b[^>]*https://[^>]*>")
"""Links of the page to other servers."""


def need_rerun() -> Path:
    """Rerun's program. Raises UserError where the extra is not installed."""
    found = find_spec("rerun_cli")
    if found is None or not found.submodule_search_locations or find_spec("rerun") is None:
        raise UserError("the live view needs Rerun (170 MB) on this machine: pip install 'muster[viz]'")
    return Path(next(iter(found.submodule_search_locations))) / "rerun"


class ViewerPage:
    """Rerun's server and web viewer, until :meth:`close`.

    Args:
        port: Of the page and its stream; None: the first free one of 9090 to 9099.
        memory: What Rerun's server may keep for pages that are opened later, such as ``"256MB"``; then the oldest goes.
        file: An .rrd file to be served as it is.
        framed_by: Origins whose pages may show this one in a frame, such as ``"http://127.0.0.1:8080"``.

    Attributes:
        url: Of the page, for people.
        server: Of Rerun's server, for the SDK.

    Raises:
        UserError: Rerun is missing or does not start, or the port is taken.
    """

    def __init__(self, port: int | None, memory: str, file: Path | None = None, framed_by: Sequence[str] = ()) -> None:
        program = need_rerun()
        self._http = _listen(port)
        self._home = Path(tempfile.mkdtemp(prefix="muster-view-"))
        # Rerun's server looks at no Host header: with an address that can't be guessed no page of another name (DNS rebinding) reads
        own = f"127.{secrets.randbelow(255)}.{secrets.randbelow(255)}.{1 + secrets.randbelow(254)}"
        stream, assets = _free_port(own), _free_port(own)
        self.server = f"rerun+http://{own}:{stream}/proxy"
        self.url = f"http://{LOOPBACK}:{self._http.server_port}"
        options = {"--bind": own, "--port": stream, "--web-viewer-port": assets, "--server-memory-limit": memory}
        arguments = (str(part) for pair in options.items() for part in pair)
        command = [str(program), "--serve-web", "--newest-first", *arguments, *([str(file)] if file else [])]
        self._log = (self._home / "log").open("w+")
        self._process = subprocess.Popen(
            tied(command, [signal.SIGINT, signal.SIGHUP]),
            env=_quiet(self._home),
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
        )
        self._http.__dict__.update(
            assets=f"http://{own}:{assets}", stream=(own, stream), frames=" ".join(["'self'", *framed_by])
        )
        try:
            self._wait(own, stream, assets)
        except UserError:
            self.close()
            raise
        threading.Thread(target=self._http.serve_forever, name="page", daemon=True).start()

    def check(self) -> None:
        """Raises UserError where Rerun's server is gone."""
        if self._process.poll() is not None:
            code = self._process.returncode
            ending = f"signal {-code}" if code < 0 else f"exit code {code}"
            raise UserError(
                f"the viewer's server ended ({ending}){self._last_words()}; what it showed is lost: start the view again"
            )

    def close(self) -> None:
        """End the server and the page."""
        self._process.kill()
        self._process.wait()
        self._http.server_close()
        self._log.close()
        shutil.rmtree(self._home, ignore_errors=True)

    def __enter__(self) -> ViewerPage:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.shutdown()
        self.close()

    def _wait(self, address: str, *ports: int) -> None:
        until = time.monotonic() + _STARTED_WITHIN
        for port in ports:
            while socket.socket().connect_ex((address, port)):
                self.check()
                if time.monotonic() > until:
                    raise UserError(f"Rerun's server did not start within {_STARTED_WITHIN:.0f} s{self._last_words()}")
                time.sleep(0.02)

    def _last_words(self) -> str:
        self._log.seek(0)
        lines = re.sub(r"\x1b\[[0-9;]*m", "", self._log.read()).strip().splitlines()
        return f": {lines[-1][:200]}" if lines else ""


def _listen(port: int | None) -> ThreadingHTTPServer:
    """The page's server. Raises UserError where a port that was asked for can't be had."""
    for each in PORTS if port is None else (port,):
        try:
            return ThreadingHTTPServer((LOOPBACK, each), _Handler)
        except OSError as error:
            why = error.strerror or error
    if port is None:
        ports = f"any port of {PORTS[0]} to {PORTS[-1]}"
        raise UserError(f"the page can't be served on {ports} ({why}); choose one by --port")
    raise UserError(f"--port {port}: the page can't be served there ({why}); leave --port out for a free one")


def _free_port(address: str) -> int:
    with socket.socket() as probe:
        probe.bind((address, 0))
        port: int = probe.getsockname()[1]
        return port


def _quiet(home: Path) -> dict[str, str]:
    """The environment of Rerun's server: its reports about usage are off, whatever the user's own settings say."""
    settings = {"analytics_enabled": False, "analytics_id": "", "metadata": {}}
    own = home / "rerun"
    own.mkdir()
    places = {"config_file_path": str(own / "analytics.json"), "data_dir_path": str(own)}
    (own / "analytics.json").write_text(json.dumps({**settings, **places}))
    return {**os.environ, "XDG_CONFIG_HOME": str(home), "TELEMETRY_ENABLED": "false", "RUST_LOG": "warn"}


class _Handler(BaseHTTPRequestHandler):
    """Serves Rerun's page, and nothing to pages of other origins."""

    server: ThreadingHTTPServer

    def do_GET(self) -> None:
        """One of the page's files; ``/`` leads to the page with the view in it."""
        own = self.server.__dict__
        if not self._is_ours():
            return
        host = self.headers["Host"]
        url = urlsplit(self.path)
        try:
            if url.path == "/" and "url=" not in url.query:
                self.send_response(302)
                options = {"hide_welcome_screen": "1", "persist": "0", "theme": "dark"}
                query = {"url": f"rerun+http://{host}/proxy", **options}
                self.send_header("Location", f"http://{host}/?{urlencode(query)}")
                self.send_header("Content-Length", "0")
                self.end_headers()
            elif url.path == "/":
                with _DIRECT.open(f"{own['assets']}/") as page:
                    content = _ELSEWHERE.sub("", page.read().decode()).replace("Rerun Viewer", "muster view").encode()
                self._begin("text/html; charset=utf-8", str(len(content)))
                self.wfile.write(content)
            elif url.path in _ASSETS:
                with _DIRECT.open(f"{own['assets']}{url.path}") as asset:
                    self._begin(_ASSETS[url.path], asset.headers["rerun-final-length"])
                    shutil.copyfileobj(asset, self.wfile, 1 << 20)
            else:
                self.send_error(404)
        except urllib.error.URLError:
            self.send_error(502, "the viewer's server is gone")
        except (BrokenPipeError, ConnectionResetError):
            pass  # the page was closed meanwhile

    def do_POST(self) -> None:
        """A request for the stream (gRPC-web), which Rerun's server answers: so page and stream share one port, for tunnels."""
        if not self._is_ours():
            return
        if not self.path.startswith("/rerun."):
            self.send_error(404)
            return
        own = http.client.HTTPConnection(*self.server.__dict__["stream"])
        try:
            body = self.rfile.read(min(int(self.headers.get("Content-Length") or 0), _LARGEST_REQUEST))
            headers = {name: self.headers[name] for name in _RELAYED if name in self.headers}
            own.request("POST", self.path, body, headers)
            answer = own.getresponse()
            self.send_response(answer.status)
            for name, value in answer.getheaders():
                if name.lower() in ("content-type", "grpc-status", "grpc-message", "grpc-encoding"):
                    self.send_header(name, value)
            self.end_headers()
            while part := answer.read1(1 << 16):
                self.wfile.write(part)
        except (BrokenPipeError, ConnectionResetError):
            pass  # the page was closed meanwhile
        except (OSError, ValueError, http.client.HTTPException):
            self.close_connection = True  # the viewer's server is gone
        finally:
            own.close()

    def _is_ours(self) -> bool:
        """Whether the request names this machine, and comes from no page of another origin; else it is refused.

        The port is that of a tunnel's other end, perhaps. A page of another name (DNS rebinding) names itself.
        """
        host = self.headers.get("Host") or ""
        ours = host.partition(":")[0] in (LOOPBACK, "localhost")
        if ours and self.headers.get("Origin") in (None, f"http://{host}"):
            return True
        self.send_error(403, "this page is served to this machine alone")
        return False

    def _begin(self, kind: str, size: str | None) -> None:
        allowed = {
            "default-src": "'self' 'unsafe-inline' blob: data:",
            "script-src": "'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:",
            "connect-src": "'self' blob: data:",
            "frame-ancestors": self.server.__dict__["frames"],
        }
        self.send_response(200)
        self.send_header("Content-Type", kind)
        if size:
            self.send_header("Content-Length", size)
            self.send_header("rerun-final-length", size)  # what the page's progress goes by
        self.send_header("Content-Security-Policy", "; ".join(f"{name} {value}" for name, value in allowed.items()))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Nothing is printed for each request."""
