"""The home directory: where it is, and that one controller at a time owns it."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import re
import socket
import stat
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO

from orchestrator.domain.errors import ServerError

_OURS = re.compile(
    r"controller\.(json|lock|sock)|muster\.db(-.*|\.lock)?|\.?keys\..*|\.?bus(-users|\.).*|\.?console\..*|\.?sealing\..*|\.?aws\..*|store|supervisors|kernels|ray|lost\+found"
)
"""Names in the home directory: database, sealing key, bus, what older Musters had there, the engines' directories, and what a volume has of itself."""

_DIRECTORIES = ("store", "supervisors", "kernels", "ray")
"""Of these, the directories: of runs, and of what engines and jobs keep."""
_MADE_LATER = ("supervisors", "kernels")
"""Of these, those that are made by jobs or for them, who would make them open."""

SOCKET = "controller.sock"

_PATIENCE = 10.0
"""Seconds to wait for a controller that starts or ends, and for a command's temporary one."""

log = logging.getLogger("muster.home")


def muster_home() -> Path:
    """``$MUSTER_HOME``, by default ``~/.muster``: database, store and kernel cache."""
    return Path(os.environ.get("MUSTER_HOME") or "~/.muster").expanduser().absolute()


@dataclass(frozen=True)
class Published:
    """What the controller of a home directory has published of itself."""

    pid: int
    url: str
    temporary: bool
    """Whether it goes away with the command that started it."""
    region: str
    """AWS region in its ARNs."""
    database: str
    """Without a password."""


def published(home: Path) -> Published | None:
    """The controller of a home directory; None where it does not run, or not yet."""
    try:
        found = Published(**json.loads((home / "controller.json").read_text()))
        os.kill(found.pid, 0)
        return found
    except (OSError, ValueError, TypeError):
        return None


def local_url() -> str | None:
    """URL at which the controller of this home directory listens; None where it does not run."""
    found = published(muster_home())
    return found.url if found else None


def local_socket(home: Path) -> Path | None:
    """The Unix socket of a home directory's controller, where no other user could have put it there."""
    path = home / SOCKET
    with suppress(OSError):
        found = path.lstat()
        if stat.S_ISSOCK(found.st_mode) and found.st_uid == os.geteuid() and _is_own(home):
            return path
    return None


def _is_own(home: Path) -> bool:
    """Whether only the present user can replace files of this directory. Raises OSError."""
    found = home.stat()
    return found.st_uid == os.geteuid() and not found.st_mode & 0o022


def open_socket(home: Path) -> socket.socket | None:
    """A Unix socket in a home directory for commands of its user, whose lock is held.

    None where another user could put something in its place, and where the path is longer than the kernel takes (107 bytes):
    then commands use TCP.
    """
    path = home / SOCKET
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.unlink(missing_ok=True)
        if _is_own(home):
            listener.bind(str(path))
            path.chmod(0o600)  # nobody can connect before it listens
            listener.listen(128)
            return listener
    except OSError as error:
        log.debug("%s can't be used: %s", path, error)
    listener.close()
    return None


def make_private(home: Path) -> None:
    """Create the home directory for its user alone (0700); one that others can enter is closed to them, which is logged.

    One that holds anything but what Muster puts there stays open, since others may need that: then Muster's own directories in
    it are closed, and it is logged what is open. Raises OSError.
    """
    home.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = home.stat()
    if not found.st_mode & 0o077:
        return
    others = sorted(entry.name for entry in home.iterdir() if not _OURS.fullmatch(entry.name))
    if not others and _closed(home):
        log.warning("%s was open to other users; it is closed to them now (chmod 700)", home)
        return
    for name in _MADE_LATER:
        with suppress(OSError):  # reported by what needs it
            (home / name).mkdir(mode=0o700, exist_ok=True)
    ours = [home / name for name in _DIRECTORIES if (home / name).is_dir() and not (home / name).is_symlink()]
    is_open = [path.name for path in ours if not _closed(path)]
    log.warning(
        "%s is open to other users%s; Muster's directories in it are closed to them%s; run chmod 700 on it, or set MUSTER_HOME to "
        "another directory",
        *(home, f", since it also holds {others[0][:100]!r}" if others else ""),
        f", but for {', '.join(is_open)} (chmod failed)" if is_open else "",
    )


def _closed(directory: Path) -> bool:
    """Close it to other users; False where that is not possible."""
    try:
        directory.chmod(directory.stat().st_mode & 0o700)
    except OSError:  # another user's
        return False
    return not directory.stat().st_mode & 0o077  # a volume without permissions changes nothing


class ControllerRuns(ServerError):
    """Another controller has this home directory; the message names it."""


class HomeLock:
    """One controller a home directory: a lock that the kernel drops when the process dies, however it dies.

    Args:
        home: The home directory.
        temporary: For a command that could use another controller as well: it waits for its holder only until that listens, or is gone.
            A server also waits for the temporary controller of such a command.

    Raises:
        ControllerRuns: Another one has it.
        OSError: The directory can't be used.
    """

    def __init__(self, home: Path, temporary: bool = False) -> None:
        make_private(home)
        self.path = home / "controller.json"
        self._file: IO[str] = open(home / "controller.lock", "a")  # noqa: SIM115 - held until release()
        until = time.monotonic() + _PATIENCE
        while not self._taken():
            holder = published(home)
            if (holder and (temporary or not holder.temporary)) or time.monotonic() > until:
                self._file.close()
                raise ControllerRuns(
                    f"{home}: already served by {_holder(home)}; use that one, stop it, or set MUSTER_HOME to another directory"
                )
            time.sleep(0.05)

    def _taken(self) -> bool:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def publish(self, url: str, temporary: bool, region: str, database: str) -> None:
        """Tell commands on this machine where the controller listens, whether it goes away with the command that started it, its AWS
        region, and its database (without a password).
        """
        found = Published(os.getpid(), url, temporary, region, database)
        try:
            self.path.write_text(json.dumps(asdict(found)))
        except OSError as error:
            log.warning("%s can't be written (%s); commands need MUSTER_URL=%s", self.path, error.strerror, url)

    def withdraw(self) -> None:
        """Commands find this controller no more, and wait for the lock."""
        self.path.unlink(missing_ok=True)
        self.path.with_name(SOCKET).unlink(missing_ok=True)

    def release(self) -> None:
        self.withdraw()
        self._file.close()


def _holder(home: Path) -> str:
    """The holder of the lock of ``home``, as far as it is known."""
    try:
        found = json.loads((home / "controller.json").read_text())
        return f"a controller (pid {found['pid']}, {found['url']})"
    except (OSError, ValueError, KeyError):
        return "another controller"
