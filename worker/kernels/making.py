"""The making of the package ``muster-kernels``: it compiles the kernels of Muster's tasks for GPUs that need not be there.

Each task is listed and compiled in a process of its own, which keeps Warp's state as a training has it. ``shipped.json`` holds what a GPU
really loaded; a task that no longer lists one of those kernels is an error, since its first start would wait for it.
"""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from worker.kernels.package import FOLDER, MANIFEST, NAME, versions
from worker.settings.errors import UserError

SHIPPED = Path(__file__).with_name("shipped.json")
"""By version: the kernels that each task loaded on a GPU."""
TARGETS = ("sm80", "sm86", "sm89", "sm90", "ptx90")
"""Architectures for which there is machine code, and the one whose intermediate code the driver of a newer GPU compiles."""
_HASHES = re.compile(r"_[0-9a-f]{8}$|(?<=^muster\.task)\.[0-9a-f]{12}-\d+$")
"""In the name of a module: it changes with the code."""

Listed = list[tuple[str, int]]
"""Names of modules without hashes, and sizes of their thread blocks."""


def family(module: str) -> str:
    """The name of a module without the hash of its code: ``ccd_kernel``, ``muster.task``."""
    return _HASHES.sub("", module)


def kept(task: str) -> Listed | None:
    """What a GPU loaded for a task with the installed versions; None if `shipped.json` does not have it."""
    document = json.loads(SHIPPED.read_text()) if SHIPPED.exists() else {}
    now = {name: version for name, version in versions().items() if name in document.get("versions", {})}
    if document.get("versions") != now or task not in document["tasks"]:
        return None
    return [(name, int(block_dim)) for name, sizes in document["tasks"][task].items() for block_dim in sizes]


def keep(found: Mapping[str, Listed]) -> None:
    """Write what a GPU loaded for some tasks into ``shipped.json``; tasks of other versions are dropped."""
    document = json.loads(SHIPPED.read_text()) if SHIPPED.exists() else {}
    now = {name: version for name, version in versions().items() if name != "muster"}
    tasks = document["tasks"] if document.get("versions") == now else {}
    for task, listed in found.items():
        names = sorted({name for name, _ in listed})
        tasks[task] = {name: sorted({size for each, size in listed if each == name}) for name in names}
    lines = ",\n".join(f"{json.dumps(task)}: {json.dumps(kernels)}" for task, kernels in sorted(tasks.items()))
    SHIPPED.write_text(f'{{"versions": {json.dumps(now)},\n"tasks": {{\n{lines}\n}}}}\n')


def make(tasks: Sequence[str], targets: Sequence[str], build: Path) -> Path:
    """Compile, and pack a wheel; what ``build`` has from before is not compiled again.

    Args:
        tasks: Names of tasks.
        targets: Of :data:`TARGETS`.
        build: Directory for intermediate files and the wheel.

    Returns:
        The wheel.

    Raises:
        UserError: A kernel does not compile, or a task does not list one that a GPU loaded.
    """
    build.mkdir(parents=True, exist_ok=True)

    for task in tasks:
        command = [
            sys.executable,
            "-m",
            "worker.kernels",
            "compile",
            task,
            "--build",
            str(build),
            "--targets",
            *targets,
        ]
        if subprocess.run(command).returncode:
            raise UserError(f"the kernels of {task} are not complete; the lines above say why")
    return pack(build, tasks, targets)


def compile_task(task: str, targets: Sequence[str], build: Path) -> tuple[int, list[str]]:
    """Compile the kernels of one task into ``build``; returns their number, and what is wrong, in lines.

    This process can't train afterwards.
    """
    from worker.tasks import find_task

    task_type = find_task(task)  # before Warp is set up, as in a training
    import warp as wp

    from worker.kernels.compiling import compile_for, in_order
    from worker.kernels.listing import KernelFile, kernels_of
    from worker.kernels.warm_start import cores, mark_of
    from worker.learning.algorithms import find_algorithm, installed

    wp.config.log_level = wp.LOG_WARNING
    algorithms = tuple(module for name in installed() for module in getattr(find_algorithm(name), "kernels", ()))
    caches = {target: build / target for target in targets}
    names: dict[str, None] = {}
    problems: list[str] = []

    def compile_now(kernels: Sequence[KernelFile]) -> None:
        names.update(dict.fromkeys(each.name for each in kernels))
        for target, cache in caches.items():
            cache.mkdir(exist_ok=True)
            for each, error in compile_for(in_order(kernels), target, cache, cores()):
                problems.append(f"{task}: {each.module.name} for {target}: {' '.join(str(error).split())[:300]}")

    def noted(kernels: KernelFile) -> None:
        # the next overload of a generic kernel changes its module
        if any(each.is_generic for each in kernels.module.kernels.values()):
            compile_now([kernels])

    found = kernels_of(
        task_type, task_type.config_type(), "cpu", algorithms=algorithms, has_picture=True, for_gpu=True, noted=noted
    )
    listed = {(family(each.module.name), each.block_dim) for each in found}
    for name, block_dim in kept(task) or ():
        if (name, block_dim) not in listed:
            problems.append(f"{task}: a GPU loads {name} for blocks of {block_dim}, and the list does not have it")
    compile_now(found)
    for target in targets:
        entries = [*names, mark_of(task_type, target)]
        (build / f"{target}.{task}.json").write_text(json.dumps(entries))
    return len(names), problems


def loaded_on_gpu(task: str) -> Listed:
    """What a task, all algorithms and a picture load on this machine's GPU, with every launch made. This process can't train afterwards."""
    from worker.tasks import find_task

    task_type = find_task(task)
    import torch
    import warp as wp
    from warp._src import context

    from worker.learning.algorithms import find_algorithm, installed
    from worker.telemetry.picture import EpisodePicture

    if not torch.cuda.is_available():
        raise UserError("this machine has no GPU, or PyTorch can't use it; the list is of what a GPU loads")
    found: dict[tuple[str, int], None] = {}
    load = context.Module.load

    def noted(module: Any, device: Any, block_dim: int | None = None, *further: Any, **named: Any) -> Any:
        if wp.get_device(device).is_cuda:
            found[family(module.name), block_dim or module.options["block_dim"]] = None
        return load(module, device, block_dim, *further, **named)

    setattr(context.Module, "load", noted)  # noqa: B010 - Warp's annotation is of the method itself
    wp.config.log_level = wp.LOG_WARNING
    for name in installed():
        for module in getattr(find_algorithm(name), "kernels", ()):
            wp.load_module(module, "cuda:0")
    config = task_type.config_type()
    with torch.cuda.stream(torch.cuda.Stream()):
        worlds = task_type(config, 64, device="cuda:0")
        drawing = EpisodePicture(worlds)
        for _ in range(3):
            worlds.step(torch.zeros_like(worlds.actions))
        drawing.picture(config)
    return list(found)


def pack(build: Path, tasks: Sequence[str], targets: Sequence[str]) -> Path:
    """Pack what :func:`compile_task` left in ``build`` for these tasks into a wheel, whose path is returned; the same files give the same bytes."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    found = versions()
    version = found["muster"] or "0"
    stem = f"{FOLDER}-{version}"
    files: dict[str, bytes] = {
        f"{FOLDER}/__init__.py": b'"""Compiled kernels of Muster\'s tasks: data for worker.kernels.package."""\n'
    }
    archives = {}
    for target in targets:
        entries = {name for task in tasks for name in json.loads((build / f"{target}.{task}.json").read_text())}
        path, size = _archive(build, target, sorted(entries))
        data = path.read_bytes()
        files[f"{FOLDER}/{path.name}"] = data
        archives[target] = {"file": path.name, "sha256": hashlib.sha256(data).hexdigest(), "unpacked": size}
    toolkit = wp.get_cuda_toolkit_version()
    manifest = {"versions": found, "toolkit": toolkit, "tasks": sorted(tasks), "archives": archives}
    files[f"{FOLDER}/{MANIFEST}"] = json.dumps(manifest, indent=1).encode()
    info = f"{stem}.dist-info"
    files[f"{info}/METADATA"] = (
        f"Metadata-Version: 2.1\nName: {NAME}\nVersion: {version}\nSummary: Compiled kernels of Muster's tasks\n"
        f"License: Apache-2.0\nRequires-Dist: muster=={version}\n"
    ).encode()
    files[f"{info}/WHEEL"] = b"Wheel-Version: 1.0\nGenerator: muster\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    record = "".join(f"{name},sha256={_urlsafe(data)},{len(data)}\n" for name, data in files.items())
    files[f"{info}/RECORD"] = f"{record}{info}/RECORD,,\n".encode()
    wheel = build / f"{stem}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:  # what is in it is compressed already
        for name, data in files.items():
            entry = zipfile.ZipInfo(name)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, data)
    return wheel


def _archive(build: Path, target: str, entries: Sequence[str]) -> tuple[Path, int]:
    """The archive of a target, and its size unpacked [bytes]: descriptions and binaries, without sources."""
    path, size = build / f"{target}.tar.xz", 0
    suffix = ".cubin" if target.startswith("sm") else ".ptx"
    with tarfile.open(path, "w:xz", preset=6) as archive:
        for entry in entries:
            if entry.startswith("wp_muster_"):
                archive.addfile(_member(entry, tarfile.DIRTYPE))
                continue
            for file in _kept_files(build / target / entry, suffix):
                member = _member(f"{entry}/{file.name}", tarfile.REGTYPE)
                member.size = file.stat().st_size
                size += member.size
                with file.open("rb") as data:
                    archive.addfile(member, data)
    return path, size


def _kept_files(folder: Path, suffix: str) -> Iterator[Path]:
    for each in sorted(folder.iterdir()):
        if each.suffix in (suffix, ".meta"):
            yield each


def _member(name: str, kind: bytes) -> tarfile.TarInfo:
    """An entry of an archive without owner and time: the same kernels give the same bytes."""
    member = tarfile.TarInfo(name)
    member.type, member.mode = kind, 0o755 if kind == tarfile.DIRTYPE else 0o644
    return member


def _urlsafe(data: bytes) -> str:
    import base64

    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
