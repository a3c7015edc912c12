"""A volume that stalls: whoever opens something of it hangs. Root only: the kernel asks this process whether a file may be opened."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

_CLASS_CONTENT, _CLOSE_ON_EXEC = 0x4, 0x1
_ADD = 0x1
_OPEN_PERMISSION, _OF_CHILDREN, _OF_DIRECTORIES = 0x10000, 0x08000000, 0x40000000
_HERE = -100


@contextlib.contextmanager
def stalled(*directories: Path) -> Iterator[None]:
    """Until the end of the block nobody can open these directories, or a file in one: the call waits. Skips where that can't be done.

    ``fanotify`` asks for a permission that nobody gives; closing its descriptor lets all calls go on.
    """
    kernel = ctypes.CDLL(None, use_errno=True)
    descriptor = kernel.fanotify_init(_CLASS_CONTENT | _CLOSE_ON_EXEC, os.O_RDONLY)
    if descriptor < 0:
        pytest.skip(f"fanotify can't be used here: {os.strerror(ctypes.get_errno())}")
    try:
        for directory in directories:
            mask = ctypes.c_uint64(_OPEN_PERMISSION | _OF_CHILDREN | _OF_DIRECTORIES)
            if kernel.fanotify_mark(descriptor, _ADD, mask, _HERE, os.fsencode(directory)):
                pytest.skip(f"{directory} can't be stalled: {os.strerror(ctypes.get_errno())}")
        yield
    finally:
        os.close(descriptor)
