"""What pip makes of this repository's wheels without extras: a controller with its plug-in, and one without it."""

from __future__ import annotations

import os
import shutil
import subprocess
import venv
import zipfile
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY, wait_for

JOB = "name: bare\nnodes: 2\nresources: {cpus: 0.1, memory: 16MiB}\ncommand: [python, -c, 'print(6 * 7)']\n"


def tracked() -> list[str]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    return [name for name in listed.stdout.split("\0") if name and (REPOSITORY / name).is_file()]


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Built of copies, since pip builds in the source tree."""
    source = tmp_path_factory.mktemp("source")
    for name in tracked():
        if not name.startswith(("tests/", "benchmarks/", "docs/")):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(REPOSITORY / name, source / name)
    made = tmp_path_factory.mktemp("wheels")
    python = Path(tmp_path_factory.mktemp("builds"), "python")
    venv.create(python, with_pip=True)
    build = [str(python / "bin" / "python"), "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(made)]
    subprocess.run([*build, str(source), str(source / "racer")], check=True, capture_output=True, timeout=300)
    found = sorted(made.iterdir())
    assert [path.name for path in found] == [
        "muster-0.1.0-py3-none-any.whl",
        "muster_racer-0.1.0-py3-none-any.whl",
    ]
    return found


def test_each_wheel_has_all_of_its_own_packages_and_the_licence(wheels: list[Path]) -> None:
    for wheel, packages in zip(wheels, ({"orchestrator", "shared_store", "worker"}, {"racer"}), strict=True):
        names = zipfile.ZipFile(wheel).namelist()
        assert {name.partition("/")[0] for name in names if name.endswith(".py")} == packages
        assert any(name.endswith("dist-info/licenses/LICENSE") for name in names)
        own = {name for name in tracked() if name.partition("/")[0] in packages}
        assert {name for name in own if name.endswith((".py", ".html"))} <= set(names)


class Installation:
    """An environment with the wheels and what they depend on, and a home."""

    def __init__(self, path: Path, wheels: list[Path]) -> None:
        self.binaries, self.home = path / "bare" / "bin", path / "home"
        venv.create(path / "bare", with_pip=True)
        constraints = str(REPOSITORY / "constraints.txt")
        self.pip("install", "-c", constraints, *map(str, wheels))

    def pip(self, *arguments: str) -> None:
        command = [str(self.binaries / "python"), "-m", "pip", *arguments, "-q"]
        subprocess.run(command, check=True, capture_output=True, timeout=300)

    def muster(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        env = {**os.environ, "MUSTER_HOME": str(self.home)}
        command = [str(self.binaries / "muster"), *arguments]
        return subprocess.run(command, env=env, cwd=self.home.parent, capture_output=True, text=True)

    def lacks(self, *modules: str) -> None:
        code = f"from importlib.util import find_spec; exit(any(map(find_spec, {modules!r})))"
        subprocess.run([str(self.binaries / "python"), "-c", code], cwd=self.home.parent, check=True)

    def runs_a_job(self) -> None:
        spec = self.home.parent / "job.yaml"
        spec.write_text(JOB)
        done = self.muster("run", str(spec))
        assert done.returncode == 0 and "42" in done.stdout, done.stdout + done.stderr
        wait_for(lambda: not (self.home / "controller.json").exists(), 5, "the embedded controller's end")


@pytest.fixture(scope="module")
def installation(wheels: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Installation:
    return Installation(tmp_path_factory.mktemp("installation"), wheels)


def test_a_bare_installation_gives_a_working_controller_with_the_racer_and_without_torch(
    installation: Installation,
) -> None:
    installation.lacks("torch", "warp", "newton")
    installation.runs_a_job()
    assert "league" in installation.muster("--help").stdout
    listed = installation.muster("league", "list", "--json")
    assert (listed.returncode, listed.stdout.strip()) == (0, "[]"), listed.stderr


def test_without_the_racer_the_controller_works_and_knows_nothing_of_it(installation: Installation) -> None:
    installation.pip("uninstall", "-y", "muster-racer")
    installation.lacks("racer")
    installation.runs_a_job()
    assert "league" not in installation.muster("--help").stdout
    unknown = installation.muster("league", "list")
    assert unknown.returncode == 2 and len(unknown.stderr.splitlines()) == 1, unknown.stderr
