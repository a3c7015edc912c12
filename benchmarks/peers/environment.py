"""Makes a separate environment for a peer, with the peer's own pins.

    python -m benchmarks.peers.environment mjlab [--folder .peers/mjlab] [--python python3.11] [--torch-index URL]
    python -m benchmarks.peers.environment isaaclab --python python3.12

``--torch-index`` names pip's index of torch if the usual one lacks the build for this machine. Isaac Lab's robots come from a server on
the network; Newton's own files of the same robots replace them.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from shared_store.contract.error_text import nearest

HERE = Path(__file__).parent
FOLDER = HERE.parent.parent / ".peers"
"""Default directory of the environments, one folder each."""
ASSETS = "assets"
"""Folder of robots, inside Isaac Lab's environment."""


@dataclass(frozen=True)
class Environment:
    """Recipe of an environment.

    Attributes:
        torch: Packages installed first, from torch's index; later installations keep them.
        pins: File of requirements, beside this module.
        alone: Packages installed last, without their dependencies.
        python: Suitable versions of Python, ``(3, 12)`` for 3.12.
        finish: Called with the environment's folder in the end.
    """

    torch: tuple[str, ...]
    pins: str
    alone: tuple[str, ...]
    python: tuple[tuple[int, int], ...]
    finish: Callable[[Path], None] | None = None


def make(name: str, folder: Path, python: str = sys.executable, torch_index: str | None = None) -> None:
    """Make the environment; installed packages are kept.

    Args:
        name: One of :data:`ENVIRONMENTS`.
        folder: Its directory.
        python: Its base interpreter.
        torch_index: Address of a package index for torch; None: the usual one.

    Raises:
        ValueError: The environment is unknown, or the interpreter can't be used for it.
        CalledProcessError: pip could not install something, and printed what.
    """
    if name not in ENVIRONMENTS:
        raise ValueError(f"there is no environment {name!r}; {nearest(name, ENVIRONMENTS)}")
    requested = ENVIRONMENTS[name]
    found = version_of(python)
    if found not in requested.python:
        able = ", ".join(f"{major}.{minor}" for major, minor in requested.python)
        raise ValueError(
            f"{name} needs Python {able}, {python} is {found[0]}.{found[1]}; name another one with --python"
        )
    if not (folder / "bin" / "python").exists():
        subprocess.run([python, "-m", "venv", str(folder)], check=True)
    pip = [
        str(folder / "bin" / "python"),
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-compile",
        "--disable-pip-version-check",
    ]
    index = ["--index-url", torch_index] if torch_index else []
    subprocess.run([*pip, *index, *requested.torch], check=True)
    subprocess.run([*pip, *requested.torch, "--requirement", str(HERE / requested.pins)], check=True)
    for package in requested.alone:
        subprocess.run([*pip, "--no-deps", package], check=True)
    if requested.finish:
        requested.finish(folder)


def version_of(python: str) -> tuple[int, int]:
    """Major and minor version of an interpreter. Raises ValueError if it can't be started."""
    requested = "import sys; print(*sys.version_info[:2])"
    try:
        output = subprocess.run([python, "-c", requested], check=True, capture_output=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        raise ValueError(f"{python} is not a Python that can be started ({error}); name one with --python") from error
    major, minor = map(int, output.split())
    return major, minor


ROBOTS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "Ant/ant_instanceable.usd": ("ant.usda", {}),
    "Humanoid/humanoid_instanceable.usd": (
        "humanoid.usda",
        {
            "abdomen_x": "pelvis",
            "right_knee": "right_shin",
            "left_knee": "left_shin",
            "right_elbow": "right_lower_arm",
            "left_elbow": "left_lower_arm",
        },
    ),
}
"""Replacement of each of Isaac Lab's robots: a file of Newton's, and its joints with other names in Isaac Lab."""


GROUND = "Isaac/IsaacLab/Environments/Grid/default_ground_plane_checker_v1/default_ground_plane.usda"
"""Path at which Isaac Lab looks for the ground plane."""
PLANE = """#usda 1.0
(
    defaultPrim = "ground"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "ground"
{
    def Plane "collision" (prepend apiSchemas = ["PhysicsCollisionAPI"])
    {
        uniform token axis = "Z"
        uniform token purpose = "guide"
    }
}
"""
"""A plane for collisions only, without visuals."""


def put_robots(folder: Path) -> None:
    """Put a plane and Newton's files of the ant and the humanoid at the paths of Isaac Lab's own.

    Raises:
        ValueError: A file lacks the joints of :data:`ROBOTS`.
    """
    (source,) = folder.glob("lib/python*/site-packages/newton/examples/assets")
    ground = folder / ASSETS / GROUND
    ground.parent.mkdir(parents=True, exist_ok=True)
    ground.write_text(PLANE)
    for place, (name, renamed) in ROBOTS.items():
        target = folder / ASSETS / "Isaac" / "Robots" / "IsaacSim" / place
        target.parent.mkdir(parents=True, exist_ok=True)
        text = (source / name).read_text()
        for joint, called in renamed.items():
            text, found = re.subn(rf'(def Physics\w*Joint) "{joint}"', rf'\1 "{called}"', text)
            if found != 1:
                raise ValueError(
                    f"{source / name} has {found} joints {joint}, one was expected; is it another release of Newton?"
                )
        target.write_text(text)


ENVIRONMENTS: Mapping[str, Environment] = {
    "mjlab": Environment(
        ("torch==2.13.0", "torchvision==0.28.0"), "mjlab.txt", (), ((3, 10), (3, 11), (3, 12), (3, 13))
    ),
    "isaaclab": Environment(("torch==2.11.0",), "isaaclab.txt", ("isaaclab==3.0.0",), ((3, 12),), put_robots),
}
"""The environments by name."""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", help=f"one of {', '.join(ENVIRONMENTS)}")
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--python", default=sys.executable)
    parser.add_argument("--torch-index")
    options = parser.parse_args(arguments)
    folder = options.folder or FOLDER / options.name
    try:
        make(options.name, folder, options.python, options.torch_index)
    except ValueError as error:
        parser.error(str(error))
    except subprocess.CalledProcessError as error:
        raise SystemExit(f"{' '.join(error.cmd)} failed with exit code {error.returncode}") from error
    print(f"made {folder}")


if __name__ == "__main__":
    main()
