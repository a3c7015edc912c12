"""What a process that runs a learner's function can still do once it has entered the sandbox: compute, and read what its imports need.

Landlock (or, without it, a mount namespace with nothing else in it) decides which files can be read; a seccomp filter decides which
system calls there are. Both hold for good, for the process and its threads, whatever code runs in them.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import resource
import stat
import struct
import sys
from collections.abc import Iterator
from importlib.machinery import PathFinder

PACKAGES = ("numpy", "scipy", "shapely")
"""Those that a function may import beside the standard library."""
MACHINES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
"""Processors with a table of system calls below, and what the kernel's audit calls them."""
_CALLS: dict[str, tuple[int | None, int | None]] = {
    # memory
    "brk": (12, 214),
    "mmap": (9, 222),
    "munmap": (11, 215),
    "mprotect": (10, 226),
    "mremap": (25, 216),
    "madvise": (28, 233),
    # descriptors that are open, and what may be read
    "read": (0, 63),
    "readv": (19, 65),
    "pread64": (17, 67),
    "write": (1, 64),
    "writev": (20, 66),
    "lseek": (8, 62),
    "close": (3, 57),
    "fstat": (5, 80),
    "newfstatat": (262, 79),
    "statx": (332, 291),
    "stat": (4, None),
    "lstat": (6, None),
    "access": (21, None),
    "faccessat": (269, 48),
    "getdents64": (217, 61),
    "getcwd": (79, 17),
    # threads
    "exit": (60, 93),
    "exit_group": (231, 94),
    "futex": (202, 98),
    "set_robust_list": (273, 99),
    "set_tid_address": (218, 96),
    "rseq": (334, 293),
    "membarrier": (324, 283),
    "sched_yield": (24, 124),
    "sched_getaffinity": (204, 123),
    "getcpu": (309, 168),
    # clocks, the process's signals, identity and host
    "clock_gettime": (228, 113),
    "clock_getres": (229, 114),
    "clock_nanosleep": (230, 115),
    "nanosleep": (35, 101),
    "restart_syscall": (219, 128),
    "gettimeofday": (96, 169),
    "time": (201, None),
    "times": (100, 153),
    "setitimer": (38, 103),
    "getitimer": (36, 102),
    "rt_sigaction": (13, 134),
    "rt_sigprocmask": (14, 135),
    "rt_sigreturn": (15, 139),
    "sigaltstack": (131, 132),
    "getpid": (39, 172),
    "getppid": (110, 173),
    "gettid": (186, 178),
    "getuid": (102, 174),
    "geteuid": (107, 175),
    "getgid": (104, 176),
    "getegid": (108, 177),
    "getrlimit": (97, 163),
    "getrusage": (98, 165),
    "sysinfo": (99, 179),
    "uname": (63, 160),
    "getrandom": (318, 278),
}
"""System calls that are allowed with any arguments: numbers on x86_64 and on aarch64, None where there is no such call."""
_OPENAT, _OPEN, _CLONE, _FCNTL, _PRLIMIT = (257, 56), (2, None), (56, 220), (72, 25), (302, 261)
_KILL, _TGKILL = (62, 129), (234, 131)
_NEWER = 424
"""From this number on calls have the same one on all processors. They are answered as by a kernel that lacks them (libraries then take
the older ones), since some hide from a filter what they do: clone3, openat2, io_uring."""
_LANDLOCK = 444, 445, 446
_PIVOT_ROOT = (155, 41)
_READ_FILE, _READ_DIR = 1 << 2, 1 << 3
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 5: 16}
"""By Landlock's version: how many rights on files it knows."""
_NEW_MOUNTS, _NEW_USER, _NEW_NETWORK = 0x20000, 0x10000000, 0x40000000
_NO_NEW_PRIVILEGES, _SECCOMP, _OF_FILTER = 38, 22, 2
_MOST_THREADS = 64


def enter(libc: ctypes.CDLL) -> str:
    """Give up for good what a reward function does not need.

    Args:
        libc: The C library, with ``use_errno``.

    Returns:
        Why it does not hold here, one line; empty where all of it does.
    """
    os.chdir("/")
    owner = os.getuid(), os.getgid()
    files, listed = readable()
    version = libc.syscall(_LANDLOCK[0], None, 0, 1)
    # refused in many containers: the filter refuses sockets there, too
    alone = libc.unshare(_NEW_USER | _NEW_NETWORK | (0 if version > 0 else _NEW_MOUNTS)) == 0
    libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    held = _restrict(libc, version, files, listed) if version > 0 else alone and _empty_root(libc, files, *owner)
    # of a user's threads those of the own namespace count; root has no such limit
    limit(resource.RLIMIT_NPROC, _MOST_THREADS if alone else 0)
    machine = os.uname().machine
    if machine not in MACHINES or sys.maxsize < 1 << 32:
        limit(resource.RLIMIT_NPROC, 0)
        return f"Muster has no list of the system calls of this processor ({machine})"
    if not _filter(libc, machine):
        limit(resource.RLIMIT_NPROC, 0)
        return "this kernel has no seccomp filters"
    return "" if held else "this kernel has no Landlock and allows no mount namespace"


def limit(kind: int, most: int) -> None:
    """Set a resource limit, hard and soft, as low as ``most`` or as it is."""
    hard = resource.getrlimit(kind)[1]
    least = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(kind, (least, least))


def readable() -> tuple[list[str], list[str]]:
    """Files and directories that may be read, and directories of which only the names may be."""
    standard = os.path.dirname(os.__file__)
    files, listed = [each for each in sys.path if each.endswith("lib-dynload")], [standard]
    files += [each.path for each in os.scandir(standard) if not each.name.endswith("-packages")]
    for name in PACKAGES:
        found = PathFinder.find_spec(name)
        for place in (found and found.submodule_search_locations) or ():
            files += [place, f"{place}.libs"]
            listed.append(os.path.dirname(place))
    kept: list[str] = []
    for path in sorted({*files, *_libraries()}, key=lambda path: path.split("/")):
        if not (kept and path.startswith(f"{kept[-1]}/")):
            kept.append(path)
    return kept, listed


def _libraries() -> Iterator[str]:
    """Shared libraries that the loader finds by their names: in its cache, where the system has one, else beside the C library."""
    folders = [f"{sys.base_prefix}/lib", *os.environ.get("LD_LIBRARY_PATH", "").split(":")]
    try:
        with open("/etc/ld.so.cache", "rb") as cache:
            yield cache.name
            yield from map(os.fsdecode, re.findall(rb"/[^\0]+\.so[^\0]*", cache.read()))
    except OSError:
        with open("/proc/self/maps") as maps:
            folders += map(os.path.dirname, re.findall(r"(/\S+\.so\S*)\n", maps.read()))
    for folder in set(folders) - {""}:
        with contextlib.suppress(OSError):
            yield from (each.path for each in os.scandir(folder) if ".so" in each.name and each.is_file())


def _restrict(libc: ctypes.CDLL, version: int, files: list[str], listed: list[str]) -> bool:
    """Landlock: nothing on the file system but to read these, no TCP, no signal to and no abstract socket of other processes."""
    rights = (1 << max(bits for least, bits in _FILE_RIGHTS.items() if least <= version)) - 1
    fields = [rights, *([3] if version >= 4 else []), *([3] if version >= 6 else [])]
    attributes = struct.pack(f"={len(fields)}Q", *fields)
    rules = libc.syscall(_LANDLOCK[0], attributes, len(attributes), 0)
    if rules < 0:
        return False
    for path, allowed in [*((each, _READ_FILE | _READ_DIR) for each in files), *((each, _READ_DIR) for each in listed)]:
        with contextlib.suppress(OSError), _opened(path) as place:
            if not stat.S_ISDIR(os.fstat(place).st_mode):
                allowed = _READ_FILE
            libc.syscall(_LANDLOCK[1], rules, 1, struct.pack("=Qi", allowed, place), 0)
    held = libc.syscall(_LANDLOCK[2], rules, 0)
    os.close(rules)
    return bool(held == 0)


@contextlib.contextmanager
def _opened(path: str) -> Iterator[int]:
    """A descriptor that stands for a path."""
    place = os.open(path, os.O_PATH | os.O_CLOEXEC)
    try:
        yield place
    finally:
        os.close(place)


def _empty_root(libc: ctypes.CDLL, files: list[str], user: int, group: int) -> bool:
    """In new namespaces: a root with these files alone. The filter keeps them from being written."""
    private, bind, no_programs, detach = 0x44000, 0x1000, 0xE, 2

    def mount(source: str, target: str, kind: bytes | None, flags: int) -> None:
        if libc.mount(source.encode(), os.fsencode(target), kind, flags, None):
            raise OSError(ctypes.get_errno(), "mount")

    try:
        for name, text in (("setgroups", "deny"), ("uid_map", f"{user} {user} 1"), ("gid_map", f"{group} {group} 1")):
            with open(f"/proc/self/{name}", "w") as file:
                file.write(text)
        mount("none", "/", None, private)
        # its own tmpfs stands at /tmp until it becomes the root; what lies there is opened before
        with contextlib.ExitStack() as stack:
            places = {each: stack.enter_context(_opened(each)) for each in files if os.path.exists(each)}
            mount("none", "/tmp", b"tmpfs", no_programs)
            for path, place in places.items():
                target = f"/tmp{path}"
                os.makedirs(os.path.dirname(target), exist_ok=True)
                if stat.S_ISDIR(os.fstat(place).st_mode):
                    os.mkdir(target)
                else:
                    os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_CLOEXEC))
                mount(f"/proc/self/fd/{place}", target, None, bind)
        os.chdir("/tmp")
        if libc.syscall(_PIVOT_ROOT[os.uname().machine == "aarch64"], b".", b".") or libc.umount2(b".", detach):
            return False
        os.chdir("/")
    except OSError:
        return False
    return True


_LOAD, _JUMP, _ANY_BIT, _AT_LEAST, _ANSWER = 0x20, 0x15, 0x45, 0x35, 0x06
_ALLOW, _KILL_PROCESS, _EPERM, _ENOSYS = 0x7FFF0000, 0x80000000, 0x50001, 0x50026
_THREAD, _NAMESPACES = 0x10000, 0x7E020080


def program(machine: str, process: int) -> list[tuple[int, int, int, int]]:
    """The seccomp filter, as instructions of the kernel's packet filter (code, jump if true, jump if false, operand).

    Args:
        machine: The processor, a key of :data:`MACHINES`.
        process: The only process that may be sent signals.
    """
    column = list(MACHINES).index(machine)
    allow, refuse = (_ANSWER, 0, 0, _ALLOW), (_ANSWER, 0, 0, _EPERM)
    code = [
        (_LOAD, 0, 0, 4),
        (_JUMP, 1, 0, MACHINES[machine]),
        (_ANSWER, 0, 0, _KILL_PROCESS),
        (_LOAD, 0, 0, 0),
        (_AT_LEAST, 0, 1, 1 << 30),  # x86's other numbers for the same calls
        refuse,
        (_AT_LEAST, 0, 1, _NEWER),
        (_ANSWER, 0, 0, _ENOSYS),
    ]
    for numbers in _CALLS.values():
        if (number := numbers[column]) is not None:
            code += [(_JUMP, 0, 1, number), allow]

    def where(numbers: tuple[int | None, int | None], *steps: tuple[int, int, int, int]) -> None:
        """A call that is allowed where the steps reach ``allow``, their last but one; else they reach ``refuse``, their last."""
        if (number := numbers[column]) is not None:
            code.extend([(_JUMP, 0, len(steps) + 2, number), *steps, allow, refuse])

    def word(argument: int, high: bool = False) -> tuple[int, int, int, int]:
        return (_LOAD, 0, 0, 16 + 8 * argument + 4 * high)

    writing = (
        os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_PATH | os.O_TMPFILE & ~os.O_DIRECTORY
    )
    where(_OPENAT, word(2), (_ANY_BIT, 1, 0, writing))
    where(_OPEN, word(1), (_ANY_BIT, 1, 0, writing))
    where(_CLONE, word(0), (_ANY_BIT, 2, 0, _NAMESPACES), (_ANY_BIT, 0, 1, _THREAD))
    where(_FCNTL, word(1), (_JUMP, 2, 0, 1), (_JUMP, 1, 0, 2), (_JUMP, 0, 1, 3))  # F_GETFD, F_SETFD, F_GETFL
    # the own limits, to be read
    where(_PRLIMIT, word(0), (_JUMP, 0, 5, 0), word(2), (_JUMP, 0, 3, 0), word(2, True), (_JUMP, 0, 1, 0))
    where(_KILL, word(0), (_JUMP, 0, 1, process))
    where(_TGKILL, word(0), (_JUMP, 0, 1, process))
    return [*code, refuse]


def _filter(libc: ctypes.CDLL, machine: str) -> bool:
    """Take the filter."""
    code = program(machine, os.getpid())
    packed = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *each) for each in code))
    described = ctypes.create_string_buffer(struct.pack("@HP", len(code), ctypes.addressof(packed)))
    return bool(libc.prctl(_SECCOMP, _OF_FILTER, described, 0, 0) == 0)
