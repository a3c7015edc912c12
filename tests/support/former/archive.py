"""The archive of a home of an older commit, unpacked where a test wants it, with what is known of it."""

from __future__ import annotations

import json
import subprocess
import sys
import tarfile
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from shared_store.volume.layout import Run, Store
from tests.conftest import REPOSITORY
from tests.support.former.environment import COMMIT

ARCHIVE = REPOSITORY / "tests" / "data" / f"home-{COMMIT}.tar.xz"
FACTS = "facts.json"
LIBRARIES = ("torch", "numpy", "warp-lang", "newton", "mujoco-warp")
"""Whose versions decide which bits a training computes."""


def processor() -> list[str]:
    """The kind of this machine's processor, as far as it decides which bits a training computes: PyTorch's and Warp's instructions, vendor."""
    import torch
    import warp

    vendor = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("vendor_id")][:1]
    return [
        torch.backends.cpu.get_cpu_capability(),
        warp.get_cpu_kernel_cache_key(),
        *(line.partition(":")[2].strip() for line in vendor),
    ]


@dataclass(frozen=True)
class Archived:
    """The unpacked home, and the facts beside it."""

    home: Path
    facts: dict[str, Any]

    @property
    def store(self) -> Store:
        return Store(self.home / "store")

    def run(self, name: str) -> Run:
        """The run of the job called ``name``."""
        (run,) = [each for each in self.store.runs() if each.name.startswith(f"{name}-")]
        return run

    def other_bits(self) -> str | None:
        """Why this machine computes perhaps other bits than the archive has; None where it may not."""
        libraries = {name: metadata.version(name) for name in LIBRARIES}
        here = {"processor": processor(), "libraries": libraries}
        differ = [f"{key} {self.facts[key]} there, {here[key]} here" for key in here if here[key] != self.facts[key]]
        return "; ".join(differ) or None


def lift_database(home: Path) -> None:
    """Bring the database of an older commit's home to the tables that today's controller reads, as its refusal tells a user to."""
    command = [sys.executable, "-m", "docs.tools.lift_database", str(home / "muster.db")]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def unpack(directory: Path) -> Archived:
    """Unpack the archive into ``directory``, which is made."""
    directory.mkdir(parents=True, exist_ok=True)
    with tarfile.open(ARCHIVE) as archive:
        archive.extractall(directory, filter="data")
    home = directory / "home"
    home.chmod(0o700)
    lift_database(home)
    return Archived(home, json.loads((directory / FACTS).read_text()))
