"""The package of compiled kernels: what is refused, and how it reaches Warp's cache."""

from __future__ import annotations

import hashlib
import io
import json
import os
import tarfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

from worker.kernels import package
from worker.kernels.package import Gpu, Unfit, unpack

H200 = Gpu(90, (13, 4))
MODULES = {f"wp_kernel_{number}_0123abc": os.urandom(20_000) for number in range(40)}


def archive(ending: str) -> bytes:
    """Some modules, and the mark of a task."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:xz") as found:
        for name, code in MODULES.items():
            for file, data in ((f"{name}/{name}.{ending}", code), (f"{name}/{name}.meta", b"{}")):
                member = tarfile.TarInfo(file)
                member.size = len(data)
                found.addfile(member, io.BytesIO(data))
        mark = tarfile.TarInfo("wp_muster_task")
        mark.type, mark.mode = tarfile.DIRTYPE, 0o755
        found.addfile(mark)
    return buffer.getvalue()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A package, as :mod:`worker.kernels.making` lays it out."""
    found = tmp_path / "muster_kernels"
    found.mkdir(mode=0o755)
    archives = {}
    for target, ending in (("sm90", "sm90.cubin"), ("ptx90", "sm90.ptx")):
        data = archive(ending)
        (found / f"{target}.tar.xz").write_bytes(data)
        archives[target] = {"file": f"{target}.tar.xz", "sha256": hashlib.sha256(data).hexdigest()}
    manifest = {"versions": package.versions(), "toolkit": [13, 4], "archives": archives}
    (found / "manifest.json").write_text(json.dumps(manifest))
    for file in found.iterdir():
        file.chmod(0o644)
    return found


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    (tmp_path / "cache").mkdir()
    return tmp_path / "cache"


def changed(**entries: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        manifest = json.loads((folder / "manifest.json").read_text())
        (folder / "manifest.json").write_text(json.dumps({**manifest, **entries}))

    return change


def append(folder: Path) -> None:
    with (folder / "sm90.tar.xz").open("ab") as file:
        file.write(b"0")


@pytest.mark.parametrize(
    ("change", "gpu", "words"),
    [
        (append, H200, r"sm90.tar.xz was changed: its digest is not that of manifest.json"),
        (lambda folder: (folder / "sm90.tar.xz").unlink(), H200, "sm90.tar.xz: No such file"),
        (
            lambda folder: (folder / "sm90.tar.xz").chmod(0o664),
            H200,
            r"sm90.tar.xz can be written by others \(mode 664\)",
        ),
        (lambda folder: (folder / "manifest.json").chmod(0o646), H200, r"manifest.json can be written by others"),
        (lambda folder: folder.chmod(0o777), H200, r"muster_kernels can be written by others \(mode 777\)"),
        (changed(versions={**package.versions(), "newton": "1.7.0"}), H200, r"made for newton 1.7.0 \(here 1\."),
        (None, Gpu(90, (12, 8)), "needs a driver for CUDA 13.0, and this one is for CUDA 12.8"),
        (None, Gpu(100, (13, 3)), "needs a driver for CUDA 13.4, and this one is for CUDA 13.3"),
        (None, Gpu(75, (13, 4)), "it has ptx90, sm90, and this GPU is sm75"),
        (lambda folder: (folder / "manifest.json").write_text("{"), H200, "manifest.json can't be read"),
    ],
)
def test_a_package_that_does_not_fit_or_that_others_could_have_written_leaves_the_cache_alone(
    folder: Path, cache: Path, change: Callable[[Path], None] | None, gpu: Gpu, words: str
) -> None:
    if change:
        change(folder)
    with pytest.raises(Unfit, match=words) as refused:
        unpack(folder, gpu, cache)
    assert "\n" not in str(refused.value) and not any(cache.iterdir())


def test_a_file_of_another_user_is_refused(folder: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if os.getuid() == 0:
        os.chown(folder / "sm90.tar.xz", 65534, 65534)
    else:
        monkeypatch.setattr("os.getuid", lambda: 1 + (folder / "manifest.json").stat().st_uid)
    with pytest.raises(Unfit, match=r"belongs to user \d+, who could put any code there"):
        unpack(folder, H200, cache)


def test_a_newer_gpu_takes_the_code_that_its_driver_compiles(folder: Path, cache: Path) -> None:
    assert unpack(folder, Gpu(100, (13, 4)), cache) == "ptx90"
    assert [each.suffix for each in sorted((cache / next(iter(MODULES))).iterdir())] == [".meta", ".ptx"]


def test_what_was_unpacked_once_is_not_read_again(folder: Path, cache: Path) -> None:
    assert unpack(folder, H200, cache) == "sm90"
    (folder / "sm90.tar.xz").unlink()
    assert unpack(folder, H200, cache) == "sm90" and (cache / "wp_muster_task").is_dir()


def test_nodes_that_fill_a_cache_at_once_leave_whole_files_in_it(folder: Path, cache: Path) -> None:
    with ProcessPoolExecutor(4, mp_context=get_context("spawn")) as pool:
        calls = [pool.submit(unpack, folder, H200, cache) for _ in range(8)]
        assert {call.result() for call in calls} == {"sm90"}
    for name, code in MODULES.items():
        assert (cache / name / f"{name}.sm90.cubin").read_bytes() == code
        assert (cache / name / f"{name}.meta").read_bytes() == b"{}"
    assert len(list(cache.iterdir())) == len(MODULES) + 2  # with the marks of the task and of the package
