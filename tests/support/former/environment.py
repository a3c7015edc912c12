"""An environment with the code of an older commit and the libraries of this one."""

from __future__ import annotations

import io
import subprocess
import sysconfig
import tarfile
import tomllib
import venv
from pathlib import Path

from tests.conftest import REPOSITORY

COMMIT = "8f62cff"
"""The commit that all of this is about: the last one before modules moved into rooms."""
_PARTS = ("orchestrator", "shared_store", "worker", "containers", "pyproject.toml")
"""What the environment needs of it."""


def is_in_history(commit: str = COMMIT) -> bool:
    """Whether this checkout's history holds the commit; a copy without ``.git``, or a shallow one, does not."""
    requested = subprocess.run(["git", "cat-file", "-e", f"{commit}^{{commit}}"], cwd=REPOSITORY, capture_output=True)
    return requested.returncode == 0


def make_environment(directory: Path, commit: str = COMMIT) -> tuple[str, ...]:
    """Make an environment of the commit in ``directory``; returns how its ``muster`` is called.

    Its interpreter finds the commit's code and entry points first, then the libraries of this environment, but not the editable
    Muster in it. So all that the controller starts is the commit's, too: nodes are started with the controller's interpreter.

    Raises:
        CalledProcessError: The history does not hold the commit.
    """
    code, environment = directory / "code", directory / "environment"
    archive = subprocess.run(["git", "archive", commit, *_PARTS], cwd=REPOSITORY, stdout=subprocess.PIPE, check=True)
    with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
        files.extractall(code, filter="data")
    venv.create(environment, symlinks=True)
    (packages,) = environment.glob("lib/python*/site-packages")
    libraries = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (packages / "former.pth").write_text("\n".join([str(code), *sorted(libraries)]) + "\n")
    _describe(packages, code / "pyproject.toml")
    return str(environment / "bin" / "python"), "-P", "-c", "from orchestrator.cli import main; main()"


def _describe(packages: Path, project_file: Path) -> None:
    """Write what an installation would: the distribution's name and its entry points."""
    project = tomllib.loads(project_file.read_text())["project"]
    groups = {"console_scripts": project["scripts"], **project["entry-points"]}
    about = packages / f"muster-{project['version']}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: muster\nVersion: {project['version']}\n")
    sections = (
        "\n".join([f"[{group}]", *(f"{name} = {value}" for name, value in names.items())])
        for group, names in groups.items()
    )
    (about / "entry_points.txt").write_text("\n\n".join(sections) + "\n")
