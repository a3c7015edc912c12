"""Kernels are compiled into Warp's cache, and what may be wrong with that cache."""

from __future__ import annotations

import os
import resource
import shutil
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, nullcontext
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import warp as wp

from tests.support.worker.loop import alone
from worker.kernels import compiling, package, warm_start
from worker.kernels.listing import KernelFile
from worker.learning.algorithm import WorldShare
from worker.learning.reporter import Beacon
from worker.learning.setup import build_task
from worker.settings.errors import TrainingError, UserError
from worker.tasks import find_task


@wp.kernel(module="unique")
def doubled(values: wp.array[wp.float32]):
    place = wp.tid()
    values[place] = 2.0 * values[place]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache."""
    wp.init()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    return tmp_path


def small() -> list[KernelFile]:
    return [KernelFile(doubled.module, 256)]


def test_a_kernel_is_compiled_for_gpus_that_are_not_there_where_warp_looks_for_it(cache: Path) -> None:
    (kernels,) = small()
    for target in ("sm90", "ptx90"):
        assert not compiling.compile_for([kernels], target, cache, 1)
    name = f"wp_{kernels.module.name}_{kernels.module.get_module_hash(256).hex()[:7]}"
    files = {each.name: each for each in (cache / name).iterdir()}
    assert {f"{name}.sm90.cubin", f"{name}.sm90.ptx", f"{name}.meta"} < files.keys()
    assert (
        files[f"{name}.sm90.cubin"].read_bytes()[:4] == b"\x7fELF" and "sm_90" in files[f"{name}.sm90.ptx"].read_text()
    )


def test_only_what_the_cache_lacks_is_compiled_and_counted(cache: Path) -> None:
    kernels, counts = [KernelFile(doubled.module, 1)], []
    assert compiling.missing(kernels, "cpu") == kernels
    compiling.load_all(kernels, "cpu", 2, lambda done, total: counts.append((done, total)))
    assert counts == [(1, 1)] and not compiling.missing(kernels, "cpu")


def compile_small(cache: Path) -> int:
    """Body of a process: how many of the kernels failed."""
    wp.init()
    return len(compiling.compile_for([KernelFile(doubled.module, size) for size in (32, 64, 128)], "sm90", cache, 2))


def test_processes_that_compile_into_one_cache_at_once_leave_whole_files(cache: Path) -> None:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        assert list(pool.map(compile_small, [cache] * 2)) == [0, 0]
    files = [each for each in cache.rglob("*") if each.is_file() and each.suffix != ".cu"]
    assert sorted(each.suffix for each in files) == [".cubin"] * 3 + [".meta"] * 3
    assert all(each.read_bytes()[:4] in (b"\x7fELF", b'{"do') for each in files)


def test_a_full_file_system_ends_the_compilation_in_one_line(cache: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(TrainingError, match=rf"^kernels can't be written to {cache}: File too large; free some"):
            compiling.compile_for(small(), "sm86", cache, 1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def as_nobody() -> Iterator[None]:
    """Root may write everywhere."""
    if os.getuid():
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.mark.parametrize("reason", ["Permission denied", "No space left on device"])
def test_a_cache_that_cannot_be_written_is_read_and_another_one_is_written(
    monkeypatch: pytest.MonkeyPatch, reason: str
) -> None:
    wp.init()
    with tempfile.TemporaryDirectory(prefix="muster-test-") as name:
        entry = Path(name) / "wp_a" / "wp_a.meta"
        entry.parent.mkdir()
        entry.write_text("{}")
        is_full = reason.startswith("No space")
        Path(name).chmod(0o755 if is_full else 0o555)
        monkeypatch.setattr(compiling, "ROOM", 2**62 if is_full else 0)
        monkeypatch.setattr(wp.config, "kernel_cache_dir", name)
        with nullcontext() if is_full else as_nobody():
            found, notice = compiling.open_cache()
            (found / "wp_new").mkdir()
        assert notice.startswith(f"the kernel cache {name} can't be written ({reason}): ") and "\n" not in notice
        assert str(found) == wp.config.kernel_cache_dir != name and (found / "wp_a" / "wp_a.meta").read_text() == "{}"
        shutil.rmtree(found)
        Path(name).chmod(0o755)


def test_the_cold_cache_of_a_task_is_filled_once_with_a_count(
    cache: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("MUSTER_PICTURE", "0")
    task_type = find_task("Cartpole")
    full = Path(os.environ["WARP_CACHE_PATH"]) / wp.config.version
    for entry in full.glob("wp_*"):  # all but one of its kernels, which compile in a minute
        if not entry.name.startswith(("wp_muster_", "wp__gravity_force_")):
            (cache / entry.name).symlink_to(entry)
    sent: list[dict[str, Any]] = []
    beacon = Beacon({})
    beacon.send = lambda **message: sent.append(message)  # type: ignore[method-assign]
    for _ in range(2):
        build_task(task_type, task_type.config_type(), WorldShare(0, 2, 2), alone(), 0, beacon)
    counted = [{"phase": "compiling kernels", "phase_count": count} for count in ("0/1", "1/1")]
    assert sent == [*counted, *2 * [{"phase": "building worlds", "phase_count": None}]]
    assert capsys.readouterr().out == "compiling kernels 0/1\ncompiling kernels 1/1\n"


OWN_TASK = """
import dataclasses
import warp as wp
from worker.simulation.worlds import WorldArrays
from worker.tasks import Reward, RobotArrays
from worker.tasks.library.cartpole import Cartpole

@wp.func
def broken(world: int, worlds: WorldArrays, robot: RobotArrays) -> float:
    return worlds.nothing[world]

class Broken(Cartpole):
    def declare(self, config):
        declaration = super().declare(config)
        return dataclasses.replace(declaration, rewards={**declaration.rewards, "broken": Reward(broken, weight=1.0)})
"""


def test_a_term_that_does_not_compile_is_named_in_one_line_as_without_the_dry_pass(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_broken_task.py").write_text(OWN_TASK)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    task_type = find_task("own_broken_task:Broken")
    with pytest.raises(UserError, match=r"own_broken_task.py:\d+: .*nothing.*") as refused:
        build_task(task_type, task_type.config_type(), WorldShare(0, 2, 2), alone(), 0)
    assert "\n" not in str(refused.value)


def test_a_package_of_other_versions_is_left_out_with_one_line(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (cache / "muster_kernels").mkdir(mode=0o755)
    (cache / "muster_kernels" / "manifest.json").write_text('{"versions": {}}')
    (cache / "muster_kernels" / "manifest.json").chmod(0o644)
    monkeypatch.setattr(package, "installed", lambda: cache / "muster_kernels")
    gpu = SimpleNamespace(
        arch=90, is_cpu=False, get_cuda_output_format=lambda: "cubin", get_cuda_compile_arch=lambda: 90
    )
    monkeypatch.setattr(wp, "get_device", lambda device: gpu)
    assert not warm_start.is_warm(find_task("Cartpole"), "cuda:0")
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("muster-kernels is not used: it was made for ") and line.endswith("; kernels are compiled")
