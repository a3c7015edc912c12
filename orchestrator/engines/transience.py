"""The transience of errors: which errors of the operating system pass by themselves. Pure."""

from __future__ import annotations

import errno

_FINAL = frozenset(
    {
        errno.E2BIG,  # command and environment are larger than the kernel takes
        errno.EACCES,
        errno.EINVAL,
        errno.EISDIR,
        errno.ELOOP,
        errno.ENAMETOOLONG,
        errno.ENOENT,
        errno.ENOEXEC,
        errno.ENOTDIR,
        errno.EPERM,
    }
)


def is_final(error: OSError) -> bool:
    """Whether trying again is useless: what the job asks for does not exist, is not allowed, or is malformed.

    Everything else may pass: no free descriptors, processes or memory (EMFILE, ENFILE, EAGAIN, ENOMEM), a volume that is full, read-only
    or away (ENOSPC, EDQUOT, EROFS, EIO, ESTALE), a network that is down. To wait in vain, with a reason that says for what, costs
    less than to fail a job that has done nothing wrong.
    """
    return error.errno in _FINAL
