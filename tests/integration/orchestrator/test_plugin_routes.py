"""Routes of plug-ins in a real controller: it serves what they declare, and doesn't start with what no permission could guard."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from orchestrator.api.http.app import create_app
from orchestrator.console import add_console
from orchestrator.domain.errors import ServerError
from orchestrator.plugins import add_plugins
from orchestrator.server import Server
from shared_store.contract.plugins import PluginError, plugins, sections
from tests.support.plugin_packages import write_package
from tests.support.refusals import refusal

CODE = """
from fastapi import APIRouter
from fastapi.responses import PlainTextResponse
from fastapi.staticfiles import StaticFiles
router, pages, inner = APIRouter(), APIRouter(), APIRouter()

def answer():
    return "served"

async def raw(request):
    return PlainTextResponse("served")

async def talk(socket):
    await socket.accept()

"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path."""
    before = set(sys.modules)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith(("tally", "score")):
            del sys.modules[name]
    forget()


def forget() -> None:
    for each in (plugins, sections):
        each.cache_clear()


def install(folder: Path, declaration: str, code: str, name: str = "tally") -> None:
    parts = f"routers=('{name}_parts:router',), pages=('{name}_parts:pages',)"
    write_package(folder, name, f"Plugin({parts}, {declaration})", CODE + code)
    forget()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    server = Server(tmp_path_factory.mktemp("home"), cpus=1)
    yield server
    server.close()


KINDS = {
    "router.add_route('/raw', raw, methods=['POST'])": "/api/raw is a Route",
    "router.mount('/files', StaticFiles(directory='/'))": "/api/files is a Mount",
    "router.host('x', StaticFiles(directory='/'))": "/api is a Host",
    "router.add_websocket_route('/talk', talk)": "/api/talk is a WebSocketRoute",
    "router.add_api_websocket_route('/talk', talk)": "/api/talk is a APIWebSocketRoute",
    "inner.add_route('/raw', raw); router.include_router(inner, prefix='/deep')": "/api/deep/raw is a Route",
    "pages.add_route('/praw', raw, methods=['POST'])": "/praw is a Route",
    "if hasattr(router, 'frontend'): router.frontend('/files', directory='/')\nelse: router.mount('/files', StaticFiles(directory='/'))": "/api",
}


@pytest.mark.parametrize("code", KINDS)
def test_a_route_that_no_permission_could_guard_is_refused(server: Server, folder: Path, code: str) -> None:
    install(folder, "", code)
    app = create_app(server.controller)
    add_console(app)
    output = refusal(add_plugins, app, error=PluginError)
    place = "pages" if code.startswith("pages") else "router"
    assert (
        output.startswith(f"plug-in tally: tally_parts:{place}: {KINDS[code]}")
        and "no permission could guard" in output
    )


@pytest.mark.parametrize(
    ("declaration", "code", "words"),
    [
        ("operations=('GET /api/jobs',)", "router.get('/jobs')(answer)", "its route GET /api/jobs is also that of the controller (GET /api/jobs)"),
        ("", "router.get('/jobs/{x}')(answer)", "its route GET /api/jobs/{x} is also that of the controller (GET /api/jobs/{reference})"),
        ("", "router.get('/{area}/{name}')(answer)", "its route GET /api/{area}/{name} is also that of the controller"),
        ("", "pages.get('/queues')(answer)", "its route GET /queues is also that of the controller (GET /queues)"),
        ("", "pages.get('/static/{name:path}')(answer)", "its route GET /static/{name:path} is also that of the controller"),
        ("operations=('GET /api/tally',)", "router.get('/tallies')(answer)", "operations: no route of it serves GET /api/tally; available: GET /api/tallies"),
        ("operations=('POST /api/tally',)", "router.get('/tally')(answer)", "operations: no route of it serves POST /api/tally"),
        ("navigation=(('Tally', '/tally'),)", "router.get('/tally')(answer)", "navigation: no page of it serves /tally, to which Tally leads"),
        ("", "router = 3", "routers: tally_parts:router is int, and no APIRouter"),
    ],
)  # fmt: skip
def test_a_route_that_is_there_already_or_is_not_there_is_refused(
    server: Server, folder: Path, declaration: str, code: str, words: str
) -> None:
    install(folder, declaration, code)
    app = create_app(server.controller)
    add_console(app)
    assert refusal(add_plugins, app, error=PluginError).startswith(f"plug-in tally: {words}")


def test_two_plug_ins_have_no_route_in_common(server: Server, folder: Path) -> None:
    install(folder, "", "router.get('/tally/{x}')(answer)")
    install(folder, "", "router.get('/tally/last')(answer)", "score")
    app = create_app(server.controller)
    add_console(app)
    assert refusal(add_plugins, app, error=PluginError) == (
        "plug-in tally: its route GET /api/tally/{x} is also that of plug-in score (GET /api/tally/last); choose another path"
    )


def test_a_route_is_served_by_its_method_and_whole_path_alone(folder: Path, tmp_path: Path) -> None:
    code = """
router.get("/tally/{name}")(answer)
router.post("/tally/{name}")(answer)
inner.get("/{name}")(answer)
router.include_router(inner, prefix="/tally/secret/of")
router.include_router(inner, prefix="/tally/open/of")
pages.get("/tally")(answer)
pages.post("/tally")(answer)
"""
    declared = "'GET /api/tally/{name}', 'GET /tally', 'GET /api/tally/open/of/{name}'"
    install(folder, f"operations=({declared}), navigation=(('Tally', '/tally'),)", code)
    server = Server(tmp_path / "home", cpus=1)
    try:
        server.start()
        with httpx.Client(base_url=server.url, trust_env=False) as http:
            assert http.get("/api/tally/x").json() == http.get("/tally").json() == "served"
            for method, path in (
                ("POST", "/api/tally/{name}"),
                ("GET", "/api/tally/secret/of/{name}"),
                ("POST", "/tally"),
            ):
                refused = http.request(method, path.format(name="x"))
                assert (refused.status_code, refused.json()["message"]) == (
                    403,
                    f"{method} {path} is refused for every key: its plug-in declares no permission for it (Plugin.operations)",
                )
            assert http.get("/api/tally/open/of/x").status_code == 403, "the same route is under /secret, too"
            assert http.head("/api/tally/x").status_code == http.put("/tally").status_code == 405
    finally:
        server.close()


def test_a_controller_that_can_t_add_a_plug_in_leaves_its_home_to_the_next(folder: Path, tmp_path: Path) -> None:
    install(folder, "", "router.add_route('/raw', raw)")
    output = refusal(Server, tmp_path / "home", cpus=1, error=ServerError)
    assert output.startswith("plug-in tally: tally_parts:router: /api/raw is a Route")
    for each in (*folder.glob("tally*.py"), folder / "tally-1.0.dist-info" / "entry_points.txt"):
        each.unlink()
    forget()
    Server(tmp_path / "home", cpus=1).close()
