"""A command on a kernel that refuses some system calls, through a seccomp filter: ``python -m tests.support.worker.kernel CALLS COMMAND``."""

from __future__ import annotations

import ctypes
import os
import struct
import sys

CALLS = {"landlock": (444, 444), "unshare": (272, 97), "seccomp": (157, 167)}
"""Numbers on x86_64 and aarch64; ``seccomp`` is prctl's, of which its filters are refused alone."""
_LOAD, _EQUAL, _ANSWER = 0x20, 0x15, 0x06
_ALLOW, _ENOSYS, _EINVAL = 0x7FFF0000, 0x50026, 0x50016


def without(calls: list[str]) -> None:
    """Have this process, and all that it starts, live without these calls."""
    column = ("x86_64", "aarch64").index(os.uname().machine)
    code = [(_LOAD, 0, 0, 0)]
    for each in calls:
        if each == "seccomp":
            code += [
                (_EQUAL, 0, 4, CALLS[each][column]),
                (_LOAD, 0, 0, 16),
                (_EQUAL, 0, 1, 22),
                (_ANSWER, 0, 0, _EINVAL),
            ]
            code += [(_ANSWER, 0, 0, _ALLOW)]
        else:
            code += [(_EQUAL, 0, 1, CALLS[each][column]), (_ANSWER, 0, 0, _ENOSYS)]
    code.append((_ANSWER, 0, 0, _ALLOW))
    packed = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *each) for each in code))
    described = ctypes.create_string_buffer(struct.pack("@HP", len(code), ctypes.addressof(packed)))
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.prctl(38, 1, 0, 0, 0) == 0 and libc.prctl(22, 2, described, 0, 0) == 0, os.strerror(ctypes.get_errno())


if __name__ == "__main__":
    without([each for each in sys.argv[1].split(",") if each])
    os.execvp(sys.argv[2], sys.argv[2:])
