"""A volume that stalls: whoever opens (or reads) something of it hangs. Root only: the kernel asks this process whether that is allowed."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

_CLASS_CONTENT, _CLOSE_ON_EXEC = 0x4, 0x1
_ADD = 0x1
_OPEN_PERMISSION, _READ_PERMISSION = 0x10000, 0x20000
_OF_CHILDREN, _OF_DIRECTORIES = 0x08000000, 0x40000000
_HERE = -100


@contextlib.contextmanager
def stalled(*paths: Path, reads: bool = False) -> Iterator[None]:
    """Until the end of the block nobody can open these, or a file in a directory of them: the call waits. Skips where that can't be done.

    ``reads``: what is opened from now on can't be read instead.

    ``fanotify`` asks for a permission that nobody gives; closing its descriptor lets all calls go on.
    """
    kernel = ctypes.CDLL(None, use_errno=True)
    descriptor = kernel.fanotify_init(_CLASS_CONTENT | _CLOSE_ON_EXEC, os.O_RDONLY)
    if descriptor < 0:
        pytest.skip(f"fanotify can't be used here: {os.strerror(ctypes.get_errno())}")
    try:
        for path in paths:
            refused = _READ_PERMISSION if reads else _OPEN_PERMISSION
            mask = ctypes.c_uint64(refused | _OF_CHILDREN | _OF_DIRECTORIES)
            if kernel.fanotify_mark(descriptor, _ADD, mask, _HERE, os.fsencode(path)):
                pytest.skip(f"{path} can't be stalled: {os.strerror(ctypes.get_errno())}")
        yield
    finally:
        os.close(descriptor)
