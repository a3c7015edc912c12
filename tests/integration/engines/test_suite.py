"""The importable suite of engines, which the one of docs/engines/write-your-own.md passes; and that through a controller."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from orchestrator.engines.local.engine import LocalEngine
from orchestrator.engines.testing.rigs import FakeRig, ShellRig
from orchestrator.engines.testing.suite import EngineSuite
from tests.conftest import REPOSITORY
from tests.support.engines.every_engine import EveryEngine
from tests.support.engines.fixtures import sites
from tests.support.engines.sites import SITES

PAGE = REPOSITORY / "docs" / "engines" / "write-your-own.md"


class TestFakeEngine(EngineSuite):
    @pytest.fixture
    def rig(self) -> FakeRig:
        return FakeRig()


class TestLocalEngine(EngineSuite):
    @pytest.fixture
    def rig(self, tmp_path: Path) -> Iterator[ShellRig]:
        with ShellRig(tmp_path / "store", lambda: LocalEngine(tmp_path, cpus=4, gpus=[])) as rig:
            yield rig


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the engine of the page and its test, and with what pip would write of its entry point."""
    folder = tmp_path_factory.mktemp("plain")
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
        (folder / re.match(r'"""(\w+\.py): ', block)[1]).write_text(block)
    [project] = re.findall(r"```toml\n(.*?)```", PAGE.read_text(), re.DOTALL)
    found = folder / "muster_plain-1.dist-info"
    found.mkdir()
    (found / "METADATA").write_text("Metadata-Version: 2.1\nName: muster-plain\nVersion: 1\n")
    points = re.search(r'\[project\.entry-points\."(.+?)"\]\n(\w+) = "(.+?)"', project)
    assert points is not None
    (found / "entry_points.txt").write_text(f"[{points[1]}]\n{points[2]} = {points[3]}\n")
    return folder


def python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)


def test_the_engine_of_the_page_has_under_300_lines_and_passes_the_suite(written: Path) -> None:
    assert len((written / "muster_plain.py").read_text().splitlines()) < 300
    done = python(written, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_plain.py")
    tests = [name for name in dir(EngineSuite) if name.startswith("test_")]
    assert done.returncode == 0 and f"{len(tests)} passed" in done.stdout, done.stdout + done.stderr


def test_an_engine_of_another_package_is_found_by_its_entry_point_and_has_its_options(written: Path) -> None:
    code = (
        "import pathlib; from orchestrator.engines.api import Setting; from orchestrator.engines.installed import *;"
        "print(ENGINES, make_engine('plain', Setting(pathlib.Path('.'), cpus=2)).capacity().machines[0].name)\n"
        "check_tags({'muster:niceness': '5'}, ['plain'])\n"
        "try: check_tags({'muster:nicenes': '5'}, ['plain'])\n"
        "except ValueError as error: print(error)"
    )
    done = python(written, "-c", code)
    assert done.stdout.splitlines() == [
        "('local', 'docker', 'ray', 'slurm', 'aws-batch', 'plain') plain/here",
        "tag muster:nicenes: a compute environment of the plain engine has no such option; did you mean niceness?",
    ], done.stderr


# -- through a controller ----------------------------------------------------------------------------------------------


site = sites(*(name for name in SITES if name != "ray"))  # whose cluster takes a minute to start: see tests/cluster


class TestEveryEngine(EveryEngine):
    pass
