"""``muster doctor``: check Muster's requirements on this machine, with advice for those that are not met."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from orchestrator.cli.command_options import JsonOption, StoreOption
from orchestrator.cli.terminal import Console, echo_json
from orchestrator.client import Client
from orchestrator.domain.errors import ApiError, Unreachable
from orchestrator.domain.hosts import Limit, Queued
from orchestrator.engines.api import EngineError, Setting
from orchestrator.engines.installed import make_engine
from orchestrator.engines.toolkit.gpus import visible_gpus
from orchestrator.home import local_url, muster_home
from shared_store import __version__
from shared_store.contract.error_text import counted
from shared_store.contract.plugins import plugins
from shared_store.process.cgroups import own_group
from shared_store.process.memory_groups import limits_memory
from shared_store.volume.files import DamagedFile, write_json
from shared_store.volume.layout import Store
from shared_store.volume.plugin_folders import orphans

_WORKER = ("torch", "warp-lang", "newton", "rsl-rl-lib", "gymnasium")
_LEAST_SHARED_MEMORY = 256
"""Size of /dev/shm [MiB] below which NCCL between ranks of one node was observed to fail (Docker's default is 64)."""
_MARKS = {"ok": "[green]ok [/]", "absent": "[yellow]-  [/]", "bad": "[red]BAD[/]"}
_LEAST_SPACE = 5
"""GiB."""


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    what: str
    state: str
    """``ok``; ``absent``: optional and missing; ``bad``: required and broken."""
    text: str


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster doctor --engine docker --store /mnt/efs/muster")(doctor)


def doctor(
    engine: Annotated[
        list[str] | None, typer.Option(metavar="ENGINE", help="An engine that must work here. Repeatable.")
    ] = None,
    store: StoreOption = None,
    worker: Annotated[bool, typer.Option("--worker", help="Require that this machine can run nodes.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Check whether this machine meets Muster's requirements.

    It exits with 1 if a requested part is missing.
    """
    findings = list(_examine(engine or [], Path(store).expanduser() if store else muster_home() / "store", worker))
    if as_json:
        echo_json([asdict(finding) for finding in findings], indent=1)
    else:
        console = Console(soft_wrap=True, highlight=False)
        for finding in findings:
            console.print(f"{_MARKS[finding.state]} {finding.what:<16} {escape(finding.text)}")
    if any(finding.state == "bad" for finding in findings):
        raise typer.Exit(1)


def _examine(engines: Sequence[str], store: Path, worker: bool) -> Iterator[Finding]:
    yield Finding("muster", "ok", f"{__version__}, Python {platform.python_version()} at {sys.executable}")
    yield _packages(worker)
    gpus = visible_gpus()
    yield Finding("GPUs", "ok" if gpus else "absent", ", ".join(gpus) or "none that NVIDIA's driver lists")
    yield _checked("home", lambda: _directory(muster_home()))
    yield _checked("store", lambda: _store(store))
    yield from _plugins(store)
    yield _shared_memory()
    yield _memory_limit()
    yield _controller()
    for name in engines:
        yield _checked(f"engine {name}", partial(_engine, name))


def _checked(what: str, check: Callable[[], str]) -> Finding:
    try:
        return Finding(what, "ok", check())
    except OSError as error:
        return Finding(what, "bad", f"{error.filename}: {error.strerror}")
    except EngineError as error:
        return Finding(what, "bad", " ".join(str(error).split()))


def _packages(worker: bool) -> Finding:
    found, missing = [], []
    for name in _WORKER:
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        text = f"{', '.join(missing)} not installed: controller and command only; pip install 'muster[worker]' to run nodes"
        return Finding("packages", "bad" if worker else "absent", text)
    return Finding("packages", "ok", ", ".join(found))


def _directory(path: Path) -> str:
    path.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(path).free / 2**30
    if free < _LEAST_SPACE:
        raise OSError(0, f"{free:.1f} GiB free; {_LEAST_SPACE} are needed", str(path))
    return f"{path}, {free:.0f} GiB free"


def _store(path: Path) -> str:
    """A commit like Muster's: written, made durable, renamed, read back."""
    text = _directory(path)
    with tempfile.TemporaryDirectory(prefix=".doctor-", dir=path) as scratch:
        started = time.perf_counter()
        write_json(Path(scratch) / "commit", {"pid": os.getpid()})
        took = time.perf_counter() - started
        json.loads((Path(scratch) / "commit").read_text())
    return f"{text}, a durable write takes {took * 1000:.1f} ms"


def _plugins(store: Path) -> Iterator[Finding]:
    """The plug-ins that are installed, or those that are not and have folders in the store."""
    try:
        absent = list(orphans(Store(store)))
    except (DamagedFile, OSError) as error:
        yield Finding("plug-ins", "bad", f"{error}; until then no run and no job is deleted")
        return
    for each in absent:
        yield Finding("plug-ins", "absent", f"{each}; until then no run and no job is deleted")
    if not absent:
        yield Finding("plug-ins", "ok", ", ".join(plugins()) or "none is installed")


def _shared_memory() -> Finding:
    try:
        size = shutil.disk_usage("/dev/shm").total / 2**20
    except OSError:
        return Finding("/dev/shm", "absent", "missing; NCCL between GPUs of one machine needs it")
    if size < _LEAST_SHARED_MEMORY:
        return Finding("/dev/shm", "absent", f"{size:.0f} MiB; several GPUs on a node need more: --shm-size 2g")
    return Finding("/dev/shm", "ok", f"{size:.0f} MiB")


def _memory_limit() -> Finding:
    if limits_memory(own_group()):
        return Finding(
            "memory limit", "ok", "a controller started like this limits jobs of the Batch API on engine local"
        )
    text = "engine local can't limit memory here: no control group; systemd-run --user --scope -p Delegate=yes muster serve"
    return Finding("memory limit", "absent", text)


def _controller() -> Finding:
    url = os.environ.get("MUSTER_URL") or local_url()
    if url is None:
        return Finding("controller", "absent", f"none of {muster_home()} runs; muster serve starts one")
    try:
        with Client.connect(url, serving=True) as client:
            engines = client.get("/api/capacity")["engines"]
    except (Unreachable, ApiError) as error:
        return Finding("controller", "bad", " ".join(str(error).split()))
    return Finding("controller", "ok", f"{url}, engines {', '.join(engines)}")


def _engine(name: str) -> str:
    # an engine that launches nothing writes nothing there
    capacity = make_engine(name, Setting(muster_home())).capacity()
    if isinstance(capacity, Queued) and isinstance(capacity.limits, Limit):
        return f"queue {capacity.limits.queue}, at most {capacity.limits.resources.cpus:g} CPUs for a gang"
    hosts = [host for host in capacity.machines if not host.unavailable]
    cpus, gpus = sum(host.cpus for host in hosts), sum(len(host.gpus) for host in hosts)
    return f"{counted(len(hosts), 'host')}, {cpus:g} CPU{'s' if cpus != 1 else ''}, {counted(gpus, 'GPU')}"
