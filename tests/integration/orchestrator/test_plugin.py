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
from tests.support.plugin_packages import write_package

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
    reported = run_muster("notes", run, "walks sideways", home=server.home)
    assert (reported.returncode, reported.stdout.split()) == (0, ["RUN", "NOTES", run, "walks", "sideways"]), (
        reported.stderr
    )
    assert "Print the notes on all runs or on one, or add one." in run_muster("--help", home=server.home).stdout
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
    assert "plug-in 'notes' is not installed, so what its folder" in found
    assert Needed("run", run, "there is a note on it") not in references(Store(server.home / "store"))[0]


def test_once_it_is_removed_no_run_and_no_job_is_deleted_until_its_folder_is_moved_away(
    installed: Path, tmp_path: Path
) -> None:
    (tmp_path / "job.yaml").write_text(JOB)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(installed))
        with Serving(tmp_path, "--cpus", "4") as server:
            for _ in range(2):
                assert run_muster("run", str(tmp_path / "job.yaml"), home=tmp_path).returncode == 0
            run, other = [str(each["run"]) for each in server.client.get("/api/runs")]
            assert run_muster("notes", run, "keep it", home=tmp_path).returncode == 0
    folder = tmp_path / "store" / "notes"
    words = (
        f"plug-in 'notes' is not installed, so what its folder {folder} needs can't be known; install the package that brings it, "
        "or move the folder out of the store\n"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("PYTHONPATH", raising=False)
        with Serving(tmp_path, "--cpus", "4") as server:
            kept = server.muster("gc", "--older-than", "0m")
            assert kept.stdout.splitlines(keepends=True)[0] == f"kept: runs {run}, {other}: {words}"
            assert "deleted 0 jobs and 0 runs" in kept.stdout and len(server.client.get("/api/runs")) == 2
            refused = server.muster("runs", "delete", other, "--yes")
            assert (refused.returncode, refused.stderr) == (1, f"muster: run {other} is kept: {words}")
            folder.rename(tmp_path / "notes")
            assert "deleted 2 jobs and 2 runs" in server.muster("gc", "--older-than", "0m").stdout


def test_its_task_and_its_part_of_a_bundle_are_found(installed: Path) -> None:
    code = """
import json
from shared_store.contract.plugins import load, plugins
from worker.tasks import find_task
task = find_task("ShortCartpole")
print(json.dumps([task.__name__, load(plugins()["notes"].bundle_parts)(task.__new__(task))]))
"""
    env = {**os.environ, "PYTHONPATH": str(installed)}
    reported = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True).stdout
    assert json.loads(reported.splitlines()[-1]) == ["ShortCartpole", {"notes.json": {"task": "ShortCartpole"}}]


def test_a_controller_that_started_before_the_plug_in_was_installed_is_to_be_started_again(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTHONPATH", raising=False)
    with Serving(tmp_path, "--cpus", "1"):
        done = run_muster("notes", home=tmp_path, PYTHONPATH=str(installed))
    assert (done.returncode, done.stderr) == (
        2,
        "muster: GET /api/notes: Not Found; the controller lacks this plug-in: install its package where the controller runs, and "
        "restart the controller\n",
    )


COMMAND = "commands=(Command('tally', 'tally_parts', 'Runs', 'Count.'),)"
OPTIONS = "options=(('evaluate', 'tally_parts:MORE'),)"
SECTION = "sections=(JobSection('{}', 'counts', 'tally_parts:Tally', 'tally_parts', 'tally_parts:RULES', 'tally_parts:Watcher'),)"
OTHER = "def register(app):\n    app.command('score')(print_it)\ndef print_it() -> None:\n    pass\n"
UNREADABLE = "def register(app):\n    app.command('tally')(print_it)\ndef print_it(x: 'nowhere') -> None:\n    pass\n"
QUEUE = "from orchestrator.spec.sections import OfCheckpoint as Tally"
BROKEN = [
    (COMMAND.replace("tally'", "list'"), "--help", "", "commands: muster list is Muster's own"),
    (COMMAND.replace("_parts", "_gone"), "tally", "", "commands: tally_gone:register can't be imported (No module"),
    (COMMAND, "tally", "1 / 0", "commands: tally_parts:register can't be imported (division by zero)"),
    (COMMAND, "tally", "register = 3", "commands: tally_parts:register is int, and no Callable"),
    (COMMAND, "tally", OTHER, "commands: tally_parts failed (it registers score, and not tally)"),
    (COMMAND, "tally --help", UNREADABLE, "commands: tally_parts failed (name 'nowhere' is not defined)"),
    (OPTIONS.replace("ate'", "te'"), "--help", "", "options: unknown command evalute; did you mean e"),
    (OPTIONS, "evaluate --help", "", "options: tally_parts:MORE can't be imported"),
    ("templates='nowhere'", "serve", "", "templates: nowhere can't be imported (No module named 'nowhere')"),
    ("templates='tally'", "serve", "", "templates: tally has no folder templates with files; install it"),
    ("routers=('tally_parts:router',)", "serve", "", "routers: tally_parts:router can't be imported"),
    ("forms=('tally_parts:FORM',)", "serve", "FORM = 3", "forms: tally_parts:FORM is int, and no TaskForm"),
    (SECTION.format("tally"), "run JOB", "class Tally: pass", "sections: tally_parts:Tally failed"),
    (SECTION.format("queue"), "schema", QUEUE, "sections: tally_parts:Tally failed (queue is a key of every job"),
]
"""Declarations: a command that uses the part, the module of the parts, and the error."""


@pytest.mark.parametrize(("declaration", "command", "code", "words"), BROKEN)
def test_a_part_that_can_t_be_used_ends_a_command_with_one_line_that_names_the_plug_in(
    tmp_path: Path, declaration: str, command: str, code: str, words: str
) -> None:
    write_package(tmp_path, "tally", f"Plugin({declaration})", code)
    (tmp_path / "job.yaml").write_text(JOB)
    arguments = command.replace("JOB", str(tmp_path / "job.yaml")).split()
    done = run_muster(*arguments, home=tmp_path, PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1), done.stderr
    assert done.stderr.startswith(f"muster: plug-in tally: {words}")


def test_a_template_that_hides_another_is_refused(tmp_path: Path) -> None:
    write_package(tmp_path, "tally", "Plugin(templates='tally_pages')")
    (tmp_path / "tally_pages" / "templates").mkdir(parents=True)
    (tmp_path / "tally_pages" / "__init__.py").touch()
    (tmp_path / "tally_pages" / "templates" / "job.html").touch()
    done = run_muster("serve", home=tmp_path, PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("muster: plug-in tally: the template job.html already exists, in ")


def test_a_rank_ends_with_one_line_where_a_part_can_t_be_used(tmp_path: Path) -> None:
    write_package(tmp_path, "tally", "Plugin(bundle_parts='tally_parts:parts')", "1 / 0")
    code = "from worker.learning.job import run_command\nfrom shared_store.contract.plugins import load, plugins\n"
    code += "run_command(lambda: load(plugins()['tally'].bundle_parts))"
    env = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (
        2,
        "error: plug-in tally: bundle_parts: tally_parts:parts can't be imported (division by zero); install its package again, "
        "or remove it\n",
    )


@pytest.mark.parametrize(
    ("group", "name", "arguments"),
    [
        ("muster.tasks", "Cartpole", ("submit", "--dry-run", "job_specs/cartpole.yaml")),
        ("muster.tasks", "Cartpole", ("tasks", "Cartpole")),
        ("muster.algorithms", "ppo", ("submit", "job_specs/cartpole.yaml", "--set", "train.algorithm=ppo")),
        ("muster.engines", "local", ("serve",)),
    ],
)
def test_a_name_that_two_packages_give_means_neither(
    tmp_path: Path, group: str, name: str, arguments: tuple[str, ...]
) -> None:
    write_package(tmp_path, name, "None", module="tally", group=group)
    done = run_muster(*arguments, home=tmp_path, PYTHONPATH=str(tmp_path))
    assert done.returncode in (1, 2) and done.stderr.count("\n") == 1, done.stderr
    assert f"the name {name} is given by the package" in done.stderr
    assert f"the package {name} (tally:PLUGIN)" in done.stderr and "the package muster (" in done.stderr


def test_a_plugin_that_can_t_be_imported_ends_a_command_with_one_line(tmp_path: Path) -> None:
    write_package(tmp_path, "broken", "1 / 0")
    done = run_muster("--help", home=tmp_path, PYTHONPATH=str(tmp_path))
    words = "plug-in broken of the package broken: broken:PLUGIN can't be imported (division by zero)"
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"muster: {words}; install its package again, or remove it\n"
