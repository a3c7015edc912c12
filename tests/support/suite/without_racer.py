"""The suite without the racer: a copy of this clone that lacks its package and its tests, and an environment that never had it.

``python -m tests.support.suite.without_racer [TESTS]``, as ``make without-racer`` runs it. The copy is in ``build/without-racer``.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

REPOSITORY = Path(__file__).parents[3]
COPY = REPOSITORY / "build" / "without-racer"
ENVIRONMENT = COPY / ".venv"
TESTS = ("tests/unit", "tests/integration")
RACERS = re.compile(r"racer/|job_specs/racer|tests/\w+/racer/")
APART = ("tests/unit/test_docs.py", "tests/integration/test_installation.py")
"""The pages describe the racer, too; the test of installations has one without it itself."""


def files() -> Iterator[str]:
    """The files of this clone that git does not ignore, without the racer's."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    for name in sorted({*listed.stdout.split("\0")} - {"", *APART}):
        if not RACERS.match(name) and (REPOSITORY / name).is_file():
            yield name


def copy_environment(environment: Path) -> None:
    """As hard links, which cost nothing; as a copy where the disks differ."""
    links = subprocess.run(["cp", "-al", str(environment), str(ENVIRONMENT)], capture_output=True)
    if links.returncode:
        shutil.rmtree(ENVIRONMENT, ignore_errors=True)
        subprocess.run(["cp", "-a", str(environment), str(ENVIRONMENT)], check=True)
    [packages] = ENVIRONMENT.glob("lib/python3.*/site-packages")
    for path in (*packages.glob("*muster_racer*"), *packages.glob("__pycache__/__editable__*")):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    places = re.compile("|".join(re.escape(str(place)) for place in (environment, REPOSITORY)).encode())
    paths = {bytes(environment): bytes(ENVIRONMENT), bytes(REPOSITORY): bytes(COPY)}
    installed = (*packages.glob("__editable__*"), *packages.glob("muster*/*"))
    for path in (*(ENVIRONMENT / "bin").iterdir(), ENVIRONMENT / "pyvenv.cfg", *installed):
        if path.is_symlink() or not path.is_file():
            continue
        content = path.read_bytes()
        changed = places.sub(lambda place: paths[place.group()], content)
        if changed != content and b"\0" not in content:
            mode = path.stat().st_mode
            path.unlink()  # else the file of the environment that it is a link of would change, too
            path.write_bytes(changed)
            path.chmod(mode)


def check(python: str) -> None:
    """Raises SystemExit unless the copy is what is imported there."""
    code = "from importlib.util import find_spec as f; print(f('orchestrator').origin, f('racer'))"
    found = subprocess.run([python, "-c", code], cwd=COPY.parent, capture_output=True, text=True, env=variables())
    expected = f"{COPY / 'orchestrator' / '__init__.py'} None"
    if found.stdout.strip() != expected:
        sys.exit(f"the environment without the racer is wrong: {expected!r} expected, {found.stdout + found.stderr!r}")


def variables() -> dict[str, str]:
    """Those of this process, without what would lead to this clone."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


def main(tests: Sequence[str]) -> int:
    """Make both anew and run the tests; returns pytest's exit code."""
    shutil.rmtree(COPY, ignore_errors=True)
    for name in files():
        (COPY / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(REPOSITORY / name, COPY / name)
    copy_environment(Path(sys.prefix))
    python = str(ENVIRONMENT / "bin" / "python")
    check(python)
    report = REPOSITORY / "build" / "tests" / "without-racer.xml"
    command = [python, "-m", "pytest", "-q", "-n", "2", "--durations=20", "--junitxml", str(report), *(tests or TESTS)]
    return subprocess.run(command, cwd=COPY, env=variables()).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
