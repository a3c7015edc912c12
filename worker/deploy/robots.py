"""The robot's model file of a bundle: a copy where it is Muster's own or in the task's source, else where it comes from."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import worker.tasks.library
from worker.simulation import robot_files

if TYPE_CHECKING:
    from worker.tasks.run.task import Task

_OWN = Path(worker.tasks.library.__file__).parent


def add_robot(task: Task, bundle: Path) -> dict[str, Any] | None:
    """Put the model of the task's robot into ``robot/`` of a bundle where its licence is known to allow that; returns what it is.

    Files of other packages and of users are named with their package and its licence, and not copied: meshes may have licences of
    their own. None of a task without a robot.
    """
    declare = getattr(task, "robot", None)
    if declare is None:
        return None
    robot = declare(task.config)
    text = str(robot.file)
    found = robot_files.read(text)
    if text.lstrip().startswith("<"):
        name = f"robot.{'xml' if found.format == 'mjcf' else found.format}"
        _write(bundle / "robot" / name, text.encode())
        return {
            "source": "the task's own source",
            "format": found.format,
            "licence": "the task's",
            "file": f"robot/{name}",
        }
    path = Path(found.source)
    if path.parent == _OWN:
        _write(bundle / "robot" / path.name, path.read_bytes())
        return {"source": path.name, "format": found.format, "licence": "Apache-2.0", "file": f"robot/{path.name}"}
    scheme, _, inside = text.partition(":")
    package = {"package": inside.partition("/")[0], "newton": "newton"}.get(scheme)
    return {"source": text, "format": found.format, **_package(package), "file": None}


def _package(name: str | None) -> dict[str, str]:
    if name is None:
        return {"licence": "not known: a file of the task's author"}
    try:
        about = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        return {"package": name, "licence": "not known"}
    named = (about[key] for key in ("License-Expression", "License") if key in about)
    licence = next(filter(None, named), "not known")
    return {"package": f"{name} {about['Version']}", "licence": f"{licence.splitlines()[0]} (of the package)"}


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
