"""Law 2: orchestrator → shared_store ← worker, no torch outside the worker, and the rooms of the orchestrator."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from orchestrator.cli.catalogue import ENTRIES, load
from tests.conftest import REPOSITORY

HEAVY = {"torch", "warp", "newton", "rsl_rl", "gymnasium", "tensordict", "mujoco"}
FORBIDDEN = {
    "orchestrator": HEAVY | {"worker"},
    "shared_store": HEAVY | {"worker", "orchestrator"},
    "worker": {"orchestrator"},
    "policy_node": HEAVY | {"worker", "orchestrator", "shared_store"},
    "racer": {"muster_policy"},
}
EXISTING = [package for package in FORBIDDEN if (REPOSITORY / package).is_dir()]
"""The racer may have been removed: ``make without-racer``."""
LIGHT_IN_WORKER = ("node", "supervisor.py", "slurm_node.py", "aws_node.py", "__init__.py")

LAYERS = {
    "machine": set[str](),
    "domain": set[str](),
    "spec": {"domain"},
    "scheduling": {"domain"},
    "persistence": {"domain", "machine"},
    "engines": {"domain", "machine"},
    "control": {"domain", "machine", "spec", "scheduling", "persistence", "engines"},
    "services": {"domain", "machine", "spec", "scheduling", "persistence", "engines", "control"},
    "api": {"domain", "machine", "spec", "scheduling", "persistence", "engines", "control", "services"},
    "console": {"domain", "spec", "scheduling", "persistence", "control", "services", "api"},
    "plugins": {"services", "api"},
    "service_manager": {"machine"},
    "home": {"domain"},
    "client": {"domain", "home"},
    "server": {"domain", "engines", "persistence", "control", "services", "api", "console", "home", "plugins"},
    "cli": {"domain", "spec", "engines", "control", "client", "home", "persistence", "server", "service_manager"},
    "start": {"engines", "home", "cli"},
}
"""What each room of the orchestrator may import beside itself."""
ADAPTERS = {
    *("alembic", "boto3", "botocore", "docker", "fastapi", "httpx", "ray", "sqlalchemy", "starlette", "uvicorn"),
    "zenoh",
}
PURE = ("domain", "spec", "scheduling")
HTTP_SERVER = {"fastapi", "starlette", "uvicorn"}


@cache
def imports_of(path: Path) -> frozenset[str]:
    """Full names of everything that the module imports, at any depth of nesting."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(names)


def imported(path: Path) -> set[str]:
    return {name.partition(".")[0] for name in imports_of(path)}


def sources(package: str) -> list[Path]:
    """The modules of a package, without those that pip has copied to build it."""
    root = REPOSITORY / package
    return [path for path in sorted(root.rglob("*.py")) if path.relative_to(root).parts[0] != "build"]


@pytest.mark.parametrize("package", EXISTING)
def test_no_module_imports_what_its_room_may_not(package: str) -> None:
    modules = sources(package)
    assert len(modules) > 5
    for module in modules:
        assert not imported(module) & FORBIDDEN[package], module


def imported_modules(path: Path) -> set[tuple[str, ...]]:
    """What the module imports of the orchestrator, name by name, each by its parts."""
    return {tuple(name.split(".")) for name in imports_of(path) if name.startswith("orchestrator.")}


def modules_of(room: str) -> list[Path]:
    path = REPOSITORY / "orchestrator" / room
    return sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]


def test_every_room_has_a_layer_pure_ones_import_no_adapter_and_only_what_serves_an_http_server() -> None:
    entries = (REPOSITORY / "orchestrator").iterdir()
    assert {entry.stem for entry in entries if not entry.name.startswith("__")} == set(LAYERS)
    for room in LAYERS:
        for module in modules_of(room):
            if room in PURE:
                assert not imported(module) & ADAPTERS, module
            elif room not in ("api", "console", "plugins", "server"):
                assert not imported(module) & HTTP_SERVER, module


@pytest.mark.parametrize("room", LAYERS)
def test_a_room_of_the_orchestrator_imports_only_the_layers_below_it(room: str) -> None:
    for module in modules_of(room):
        for parts in imported_modules(module):
            assert parts[1] in {room, *LAYERS[room]}, (module, ".".join(parts))


def test_the_apis_of_aws_import_nothing_of_the_native_one_and_an_engine_no_other_engine() -> None:
    for room in ("batch", "logs"):
        for module in (REPOSITORY / "orchestrator" / "api" / room).glob("*.py"):
            assert ("api", "native") not in {parts[1:3] for parts in imported_modules(module)}, module
    engines = REPOSITORY / "orchestrator" / "engines"
    rooms = {path.name for path in engines.iterdir() if path.is_dir() and not path.name.startswith("__")}
    assert {"toolkit", "local", "docker", "ray", "slurm", "aws_batch"} <= rooms
    for room in rooms:
        for module in (engines / room).rglob("*.py"):
            used = {parts[2] for parts in imported_modules(module) if parts[1] == "engines"}
            assert used <= {"api", "toolkit", room}, module


def test_the_supervisor_imports_no_torch() -> None:
    for name in LIGHT_IN_WORKER:
        path = REPOSITORY / "worker" / name
        for module in [path] if path.suffix else path.rglob("*.py"):
            assert not imported(module) & HEAVY, module
    code = "import sys, worker.supervisor, worker.slurm_node, worker.aws_node, orchestrator.cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not set(loaded) & HEAVY


def test_help_imports_no_command_and_each_says_what_its_own_help_says() -> None:
    code = "import sys; sys.argv = ['muster', '--help']; import orchestrator.cli as c, atexit\natexit.register(lambda: print(*sys.modules)); c.main()"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "orchestrator.cli.catalogue" in loaded
    assert not {"httpx", "pydantic", "sqlalchemy", "yaml", "orchestrator.cli.jobs"} & set(loaded)
    for entry in ENTRIES:
        own = " ".join((load(entry.name).help or "").partition("\n\n")[0].split())
        assert own == entry.summary, entry.name


def test_no_module_is_too_long_to_be_seen_whole() -> None:
    for package in (*EXISTING, "tests", "benchmarks", "docs"):
        for module in sources(package):
            assert len(module.read_text().splitlines()) <= 450, module


WORKER_FLOORS = (
    {"settings"},
    {"node"},
    {"simulation"},
    {"tasks.declare"},
    {"tasks.terms"},
    {"tasks.compile"},
    {"tasks.run"},
    {"tasks.library", "tasks"},
    {"learning"},
    {"evaluation"},
    {"deploy"},
    {"telemetry"},
)
"""Rooms of the worker, each of which imports those before it; modules at the root are entries."""
ENTRIES_OF_WORKER = {
    *("aws_node", "bitwise_diff", "checkpoint_writer", "evaluate", "export", "fork_server", "record", "render"),
    *("repeat_incident", "robot", "slurm_node", "supervisor", "track", "train"),
}
STORE_FLOORS = ({"process"}, {"contract"}, {"volume"})
"""The same of the shared store."""
RACER_FLOORS = ({"store"}, {"tracks"}, {"rewards"}, {"settings"}, {"car"}, {"race"})
"""The same of the racer; beside them ``control``, for the controller and the command."""
EXEMPT = REPOSITORY / "racer" / "rewards" / "__main__.py"
"""A program, which asks the car for a job's tracks."""
FLOORS = {"worker": WORKER_FLOORS, "shared_store": STORE_FLOORS, "racer": RACER_FLOORS}


def room_of(parts: tuple[str, ...], rooms: set[str]) -> str:
    """The room of a module, by the parts of its name behind the package; its own name at the root."""
    two = ".".join(parts[:2])
    return two if two in rooms else parts[0] if parts else ""


@pytest.mark.parametrize("package", [package for package in FLOORS if package in EXISTING])
def test_no_import_of_a_room_climbs(package: str) -> None:
    level = {room: number for number, floor in enumerate(FLOORS[package]) for room in floor}
    for module in sources(package):
        if module == EXEMPT:
            continue
        own = room_of(module.relative_to(REPOSITORY / package).with_suffix("").parts, set(level))
        for name in imports_of(module):
            if name.startswith(f"{package}."):
                other = room_of(tuple(name.split(".")[1:]), set(level))
                if own in level and other in level:
                    assert own == other or level[other] < level[own], (module, name)


@pytest.mark.skipif("racer" not in EXISTING, reason="the racer is removed")
def test_the_racer_in_the_controller_imports_neither_torch_nor_numpy() -> None:
    rooms = {room for floor in RACER_FLOORS for room in floor} | {"control"}
    control = sorted((REPOSITORY / "racer" / "control").glob("*.py"))
    for module in control:
        used = {name.split(".")[1] for name in imports_of(module) if name.startswith("racer.")}
        assert used & rooms <= {"control", "store", "settings"}, module
    names = ", ".join(f"racer.control.{module.stem}" for module in control if module.stem != "__init__")
    code = f"import sys, racer.plugin, {names}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "racer.store.leagues" in loaded and not {*HEAVY, "numpy"} & set(loaded)


def test_only_entries_stand_at_the_root_of_a_package() -> None:
    modules = {path.stem for path in (REPOSITORY / "worker").glob("*.py")} - {"__init__"}
    assert modules == ENTRIES_OF_WORKER
    assert {path.stem for path in (REPOSITORY / "shared_store").glob("*.py")} == {"__init__"}
    assert {path.stem for path in (REPOSITORY / "racer").glob("*.py")} <= {"__init__", "plugin"}
