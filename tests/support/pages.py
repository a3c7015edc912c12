"""The commands of a page of the documentation, run as they stand."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.support.waiting import wait_for

PORT = 8080
"""The controller's, on the pages."""


def run_page(page: str, directory: Path, then: str = "", without: str = "make test") -> str:
    """What the ``sh`` blocks of a page print, run in their order by one shell in a copy of the repository below ``directory``.

    The copy has this environment, and a home directory of its own.

    Args:
        then: Commands for the same shell, after the page's.
        without: A command that is left out; ``make test`` would run this test.
    """
    if taken():
        pytest.skip(f"PORT {PORT}, WHICH THE PAGE USES, IS TAKEN ON THIS MACHINE")
    clone = directory / "muster"
    _copy_tree(clone)
    environment = clone / ".venv"
    environment.mkdir()
    for entry in Path(sys.executable).parent.parent.iterdir():
        if entry.name != ".ready":
            (environment / entry.name).symlink_to(entry)
    (environment / ".ready").touch()  # newer than all: `make run` installs nothing, which would change this environment
    found = re.findall(r"^```sh\n(.*?)^```", (REPOSITORY / page).read_text(), re.MULTILINE | re.DOTALL)
    script = re.sub(rf"^{without}\b", f": {without}", "\n".join([*found, then]), flags=re.MULTILINE)
    hidden = ("MUSTER_HOME", "MUSTER_URL", "MUSTER_TOKEN", "VIRTUAL_ENV")
    env = {name: value for name, value in os.environ.items() if name not in hidden}
    ending = "trap 'kill $(jobs -p) 2>/dev/null || true; wait' EXIT"
    command = ["bash", "-euxc", f"{ending}\n{script}"]
    env |= {"HOME": str(directory), "PYTHONUNBUFFERED": "1"}
    try:
        done = subprocess.run(command, cwd=clone, env=env, capture_output=True, text=True, timeout=900)
    except subprocess.TimeoutExpired as late:
        printed = [
            (each or b"").decode(errors="replace")[-6000:] for each in (late.stdout, late.stderr)
        ]  # always bytes
        alive = subprocess.run(
            ["ps", "-eo", "pid,ppid,etimes,stat,wchan:20,args"], capture_output=True, text=True
        ).stdout
        mine = "\n".join(line for line in alive.splitlines() if str(clone) in line or "muster" in line)
        pytest.fail(f"it still runs after {late.timeout:.0f} s:\n{printed[0]}\n{printed[1]}\n{mine}")
    assert done.returncode == 0, f"{done.stdout[-6000:]}\n{done.stderr[-6000:]}"
    wait_for(lambda: not taken(), 20, "the controller's end")
    return done.stdout


def repository_files(pattern: str = "*") -> list[str]:
    """What git tracks, and what it does not ignore: paths from the repository's root."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", pattern]
    names = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout
    return names.rstrip("\0").split("\0")


def _copy_tree(directory: Path) -> None:
    """Copy the repository's own files: other tests make and remove some of the rest meanwhile."""
    for name in repository_files():
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # deleted, and not committed yet
            shutil.copy2(REPOSITORY / name, directory / name)


def taken() -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", PORT)) == 0
