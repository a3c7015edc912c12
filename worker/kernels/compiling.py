"""Compile many kernels beside each other, and where to: the cache, and what may be wrong with it."""

from __future__ import annotations

import atexit
import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import warp as wp
from warp._src import context

from worker.kernels.listing import KernelFile
from worker.settings.errors import TrainingError

ROOM = 2**26
"""Free bytes without which a file system counts as full: the kernels of one task take up to 70 MB, with what the compiler leaves."""
_OF_TILES = 10
"""Functions that take as long to compile as the tiles of a kernel do."""
_PREFIX = "muster-kernels-"
"""Of the name of a temporary cache."""
_OTHER = "WARP_CACHE_PATH names another directory"
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM)


def open_cache() -> tuple[Path, str]:
    """Warp's cache; where no files can be written into it, a temporary one with links to what it has.

    Returns:
        The directory for this version of Warp, and the notice about a temporary one; it is empty without one.

    Raises:
        TrainingError: There can't be a temporary one either.
    """
    try:
        wp.init()
        if _PREFIX in str(directory()):
            return directory(), ""
        with tempfile.TemporaryFile(dir=directory()):
            pass
        if shutil.disk_usage(directory()).free < ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(directory()))
        return directory(), ""
    except OSError as error:
        cache = Path(wp.config.kernel_cache_dir or error.filename or "")
        notice = f"the kernel cache {cache} can't be written ({error.strerror}): what it lacks is compiled for this run alone; {_OTHER}"
    try:
        temporary = Path(tempfile.mkdtemp(prefix=_PREFIX))
    except OSError as error:
        raise TrainingError(f"{notice}, and no temporary directory can be made ({error.strerror})") from None
    atexit.register(shutil.rmtree, temporary, ignore_errors=True)
    wp.config.kernel_cache_dir = str(temporary)
    wp.init()  # Warp takes the directory as it is
    for entry in cache.glob("wp_*"):
        (directory() / entry.name).mkdir()
        for file in entry.iterdir():
            (directory() / entry.name / file.name).symlink_to(file)
    return directory(), notice


def directory() -> Path:
    """The cache that is in use."""
    assert wp.config.kernel_cache_dir is not None, "Warp is not set up"
    return Path(wp.config.kernel_cache_dir)


def missing(kernels: Sequence[KernelFile], device: str) -> list[KernelFile]:
    """Those that the cache does not have for ``device``. What takes longest comes first."""
    found, cache = wp.get_device(device), directory()

    def is_cached(each: KernelFile) -> bool:
        binary = each.module._get_compile_output_name(found, block_dim=each.block_dim)
        return all((cache / each.name / file).exists() for file in (binary, f"{each.name}.meta"))

    return in_order([each for each in kernels if not is_cached(each)])


def in_order(kernels: Sequence[KernelFile]) -> list[KernelFile]:
    """What takes longest first, or it would end alone: modules with many functions and kernels, and those with tiles.

    On two busy cores the collision of meshes with height fields (51 functions) took one to two minutes, and most others a few seconds. The
    libraries of tiles are linked one after the other.
    """

    def weight(each: KernelFile) -> int:
        each.module.get_module_hash(each.block_dim)
        functions = each.module.hashers[each.block_dim].function_hashes
        return len(functions) + len(each.module.kernels) + _OF_TILES * (each.block_dim != 256)

    return sorted(kernels, key=weight, reverse=True)


def load_all(kernels: Sequence[KernelFile], device: str, workers: int, progress: Callable[[int, int], object]) -> None:
    """Compile kernels into the cache and load them, ``workers`` at a time.

    Kernels that don't compile are left out: their launch says why. Where the cache can't be written, no other will compile.

    Args:
        kernels: What to load.
        device: ``"cpu"`` or ``"cuda:<n>"``.
        workers: Number of threads; the compiler holds no lock of Python's.
        progress: Called with how many are done, of how many, on this thread.

    Raises:
        TrainingError: The file system of the cache is full, or can't be written.
    """
    compile_all(kernels, lambda each: each.module.load(device, each.block_dim), workers, progress)


def compile_for(
    kernels: Sequence[KernelFile],
    target: str,
    cache: Path,
    workers: int,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> list[tuple[KernelFile, Exception]]:
    """Compile kernels for a GPU that need not be there; what ``cache`` has is not compiled again.

    Args:
        kernels: What to compile.
        target: ``sm90`` for that architecture alone, ``ptx90`` for it and all newer ones.
        cache: Directory as Warp keeps it for one version.
        workers: Number of threads.
        progress: As of :func:`load_all`.

    Returns:
        Those that failed.
    """
    is_ptx, arch = target.startswith("ptx"), int(target.lstrip("smptx"))

    def one(each: KernelFile) -> None:
        options = each.module.resolved_options[each.block_dim]
        each.module._compile(None, cache / each.name, None, arch, use_ptx=is_ptx, options=options)

    return compile_all(kernels, one, workers, progress)


def compile_all(
    kernels: Sequence[KernelFile],
    one: Callable[[KernelFile], Any],
    workers: int,
    progress: Callable[[int, int], object],
) -> list[tuple[KernelFile, Exception]]:
    """Call ``one`` for each of the kernels on threads; returns those for which it failed. Raises TrainingError, as :func:`load_all`."""
    failed: list[tuple[KernelFile, Exception]] = []
    for each in kernels:
        each.module.get_module_hash(each.block_dim)  # names no file twice: hashes are of one thread's making
    with ThreadPoolExecutor(max(1, min(workers, len(kernels)))) as pool:
        calls = {pool.submit(one, each): each for each in kernels}
        for done, call in enumerate(as_completed(calls), start=1):
            if error := call.exception():
                if problem := problem_of_cache(error):
                    pool.shutdown(cancel_futures=True)
                    raise TrainingError(problem) from error
                assert isinstance(error, Exception)
                context._clear_error_frames(error)  # they would hold the module's kernels
                failed.append((calls[call], error))
            progress(done, len(kernels))
    return failed


def problem_of_cache(error: BaseException) -> str:
    """One line, if a compilation failed for its file system; else empty. The compiler itself does not say what it could not write."""
    cache = directory()
    if isinstance(error, OSError) and error.errno in _FULL:
        reason = error.strerror
    elif isinstance(error, Exception) and shutil.disk_usage(cache).free < 2**20:
        reason = os.strerror(errno.ENOSPC)
    else:
        return ""
    return f"kernels can't be written to {cache}: {reason}; free some space; {_OTHER}"
