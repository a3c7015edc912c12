"""A plug-in from a wheel: docs/examples/notes, as docs/plug-ins.md shows it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from shared_store.volume.layout import Store
from shared_store.volume.references import Needed, references
from tests.conftest import REPOSITORY, Serving, run_muster

JOB = "name: noted\nresources: {cpus: 0.1, memory: 16MiB}\ncommand: ['true']\n"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory into which the plug-in's wheel is installed."""
    folder = tmp_path_factory.mktemp("plugin")
    shutil.copytree(REPOSITORY / "docs/examples/notes", folder / "source")
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    subprocess.run(
        [*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(folder), str(folder / "source")], check=True
    )
    (wheel,) = folder.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(folder / "site"), str(wheel)], check=True)
    return folder / "site"


@pytest.fixture(scope="module")
def server(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(installed))
        with Serving(tmp_path_factory.mktemp("home"), "--cpus", "4") as server:
            (server.home / "job.yaml").write_text(JOB)
            assert run_muster("run", str(server.home / "job.yaml"), home=server.home).returncode == 0
            yield server


def run_of(server: Serving) -> str:
    return str(server.client.get("/api/runs")[0]["run"])


def test_its_command_route_and_page_are_there(server: Serving) -> None:
    run = run_of(server)
    told = run_muster("notes", run, "walks sideways", home=server.home)
    assert (told.returncode, told.stdout) == (0, f"{run}: walks sideways\n"), told.stderr
    assert "Print the notes on runs, or add one." in run_muster("--help", home=server.home).stdout
    assert server.client.get("/api/notes") == [{"run": run, "notes": ["walks sideways"]}]
    page = httpx.get(f"{server.url}/notes", headers={"accept": "text/html"})
    assert page.status_code == 200 and "walks sideways" in page.text
    assert '<a href="/notes" aria-current="page">Notes</a>' in page.text or '/notes"' in page.text


def test_a_route_that_it_does_not_declare_is_refused_for_every_key(server: Serving) -> None:
    answer = httpx.get(f"{server.url}/api/notes/secret")
    assert (answer.status_code, answer.json()["__type"]) == (403, "AccessDeniedException")
    assert answer.json()["message"] == (
        "GET /api/notes/secret is refused for every key: its plug-in declares no permission for it (Plugin.operations)"
    )


def test_its_folder_keeps_runs_from_being_deleted_also_once_it_is_removed(server: Serving, installed: Path) -> None:
    run = run_of(server)
    server.client.post(f"/api/notes/{run}", {"text": "keep it"})
    refused = run_muster("runs", "delete", run, "--yes", home=server.home)
    assert (refused.returncode, refused.stderr) == (1, f"muster: run {run} is kept: there is a note on it\n")
    look = f"from shared_store.volume.layout import Store; from shared_store.volume.references import references; print(references(Store({str(server.home / 'store')!r})))"
    found = subprocess.run(
        [sys.executable, "-c", look], env={**os.environ, "PYTHONPATH": ""}, capture_output=True, text=True, check=True
    ).stdout
    assert (
        "what the store's notes need can't be known without the plug-in notes; install it, or move them away" in found
    )
    assert Needed("run", run, "there is a note on it") not in references(Store(server.home / "store"))[0]


def test_its_task_and_its_part_of_a_bundle_are_found(installed: Path) -> None:
    code = """
import json
from shared_store.contract.plugins import load, plugins
from worker.tasks import find_task
task = find_task("ShortCartpole")
print(json.dumps([task.__name__, load(plugins()["notes"].bundle_parts)(task.__new__(task))]))
"""
    env = {**os.environ, "PYTHONPATH": str(installed)}
    told = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True).stdout
    assert json.loads(told.splitlines()[-1]) == ["ShortCartpole", {"notes.json": {"task": "ShortCartpole"}}]


def test_a_plugin_that_can_t_be_imported_ends_a_command_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "broken-1.dist-info").mkdir()
    (tmp_path / "broken-1.dist-info" / "entry_points.txt").write_text("[muster.plugins]\nbroken = broken:PLUGIN\n")
    (tmp_path / "broken.py").write_text("1 / 0\n")
    done = run_muster("--help", home=tmp_path, PYTHONPATH=str(tmp_path))
    words = "plug-in: broken:PLUGIN can't be imported (division by zero); install its package again, or remove it"
    assert (done.returncode, done.stdout, done.stderr) == (1, "", f"muster: {words}\n")
