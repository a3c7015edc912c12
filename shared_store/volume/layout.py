"""The layout of the shared volume (``<store>/runs/<run>/…``)."""

from __future__ import annotations

import errno
import os
import re
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from shared_store.contract.plugins import OF_RUN, plugins
from shared_store.volume.files import DamagedFile, path_exists, read_json, refuse_links, write_json

FORMAT = 1
"""Version of the layout; a store with a newer one is refused."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")
"""Valid names of runs: a name becomes a directory."""

_NAMING_TRIES = 20
"""Tenths of a second to wait for another controller that is naming the store."""

LARGEST_DESCRIPTION = 128 << 10
"""Bytes of ``run.json`` and of an evaluation, which the API returns."""


class StoreError(Exception):
    """The store can't be used; the message names the path, the reason and the remedy."""


class _Part:
    """The path in a run that has the name of the attribute."""

    def __init__(self, suffix: str = "") -> None:
        self._suffix = suffix

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name + self._suffix

    def __get__(self, run: Run, owner: type) -> Path:
        return run.path / self._name


@dataclass(frozen=True)
class Run:
    """One training history, continued by one or more jobs. It has paths only, and creates nothing on access."""

    path: Path
    checkpoints = _Part()
    contract = _Part(".json")
    metrics = _Part()
    parent = _Part()
    evaluations = _Part()
    incidents = _Part()
    exports = _Part()
    recordings = _Part()
    telemetry = _Part()
    tracking = _Part()
    texts = _Part()

    @property
    def name(self) -> str:
        return self.path.name

    def teacher(self, name: str) -> Run:
        """The copy of the weights of run ``name``, the teacher of this run's policy, in the layout of a run."""
        return Run(self.path / "teachers" / name)

    def logs(self, job: str, attempt: int) -> Path:
        return self.path / "logs" / job / str(attempt)

    def log(self, job: str, attempt: int, node: int) -> Path:
        return self.logs(job, attempt) / f"node-{node}.log"

    def outcome(self, job: str, attempt: int, node: int) -> Path:
        return self.path / "outcomes" / job / str(attempt) / f"node-{node}.json"

    def check_links(self) -> None:
        """Raise DamagedFile if the run, or a directory of it that Muster uses, is a link, which leads out of the store."""
        for name in sorted(OF_RUN.union(*(plugin.run_folders for plugin in plugins().values()))):
            refuse_links(self.path / name, 2)

    def description(self) -> dict[str, Any] | None:
        """The content of ``run.json`` (spec, code versions, creation time); None if the run does not exist.

        Raises DamagedFile if it is malformed or :meth:`check_links` refuses, OSError if the volume can't be read.
        """
        self.check_links()
        path = self.path / "run.json"
        found = read_json(path, LARGEST_DESCRIPTION)
        if found is None:
            return None
        kinds = {"spec": (dict, "a mapping"), "created": (int | float, "a number"), "parent": (dict, "a mapping")}
        for key, (kind, words) in kinds.items():
            if not isinstance(found.get(key), kind | None):
                raise DamagedFile(f"{path}: {key} is not {words}")
        if not 0 <= (found.get("created") or 0) < 2**53:  # no database holds more
            raise DamagedFile(f"{path}: created is not a time")
        return found

    def is_missing(self) -> bool:
        """Whether the store can be read and lacks the run; False if that is uncertain, for example while the volume is away."""
        try:
            return not path_exists(self.path / "run.json") and os.path.lexists(self.path.parent.parent / "store.json")
        except OSError:
            return False

    def create(self, description: dict[str, Any]) -> None:
        """Write ``run.json`` once; an existing run keeps its own. Raises as :meth:`check_links`, OSError."""
        self.check_links()
        if not (self.path / "run.json").exists():
            write_json(self.path / "run.json", description, levels=2)


def check_name(what: str, name: str, error: Callable[[str], Exception]) -> None:
    """Raise what ``error`` makes of one line for an invalid name of a run, model or the like: a name becomes a directory."""
    if not NAME.fullmatch(name):
        raise error(
            f"{what} name {name[:130]!r}: use letters, digits, '.', '_' and '-' only, at most 128 of them, the first a letter or digit"
        )


@dataclass(frozen=True)
class Store:
    """The shared volume at ``path``."""

    path: Path

    def __init__(self, path: str | os.PathLike[str]) -> None:
        object.__setattr__(self, "path", Path(path).expanduser().absolute())

    def identity(self) -> str | None:
        """What tells this store from all others; None for a store of an older Muster.

        Raises FileNotFoundError where there is no store, OSError or ValueError where ``store.json`` can't be read.
        """
        found = read_json(self.path / "store.json")
        if found is None:
            raise FileNotFoundError(f"{self.path / 'store.json'}: no such file")
        identity = found.get("id")
        return identity if isinstance(identity, str) and identity else None

    def check_writable(self) -> None:
        """Raises StoreError where this user can't write at the path, or can't create it. Makes nothing."""
        present = next(each for each in (self.path, *self.path.parents) if os.path.exists(each))
        if not present.is_dir():
            raise self._not_writable(os.strerror(errno.ENOTDIR))
        if not os.access(present, os.W_OK | os.X_OK):
            is_read_only = os.statvfs(present).f_flag & os.ST_RDONLY
            raise self._not_writable(os.strerror(errno.EROFS if is_read_only else errno.EACCES))

    def check_owner(self) -> None:
        """Raises StoreError where the owner of the store's directory can't write in directories that this user makes there."""
        try:
            made, owner = self._probe(), self.path.stat()
        except OSError as error:
            raise self._not_writable(error.strerror or str(error)) from error
        bit = 0o200 if made.st_uid == owner.st_uid else 0o020 if made.st_gid == owner.st_gid else 0o002
        if owner.st_uid != 0 and not made.st_mode & bit:
            raise StoreError(
                f"store {self.path}: it belongs to user {owner.st_uid}, as whom containers run, and they can't write what this "
                f"controller makes there as user {made.st_uid}; chown the store, or start muster serve as user {owner.st_uid}"
            )

    def _probe(self) -> os.stat_result:
        """Of a directory that this user has made and removed. Raises OSError."""
        probe = self.path / "runs" / f".probe-{os.getpid()}"
        probe.mkdir()
        made = probe.stat()
        probe.rmdir()
        return made

    def _not_writable(self, why: str) -> StoreError:
        return StoreError(
            f"store {self.path}: not writable ({why}); see whether its volume is mounted, or choose another with --store"
        )

    def open(self) -> Store:
        """Create a missing layout, give the store an identity, and check that it can be written.

        Raises StoreError for a path that can't be created or written, or that holds a newer format.
        """
        try:
            (self.path / "runs").mkdir(parents=True, exist_ok=True)
            description = read_json(self.path / "store.json")
            if description is None or (description.get("format") == FORMAT and not description.get("id")):
                description = self._name(description or {"format": FORMAT})
            self._probe()
        except OSError as error:
            raise self._not_writable(error.strerror or str(error)) from error
        except ValueError as error:
            raise StoreError(f"store {self.path}: store.json is damaged ({error})") from error
        if not isinstance(description.get("format"), int) or description["format"] > FORMAT:
            raise StoreError(
                f"store {self.path}: has format {description.get('format')}, this Muster reads up to {FORMAT}; upgrade Muster"
            )
        return self

    def _name(self, description: dict[str, Any]) -> dict[str, Any]:
        """Give the store an identity. Of several controllers that do so at once, the first one's stays."""
        import secrets  # every command imports this module, and few need them

        claim = self.path / ".naming"
        with suppress(FileExistsError), open(claim, "xb") as file:
            file.write(secrets.token_hex(16).encode())
            file.flush()
            os.fsync(file.fileno())
        for _ in range(_NAMING_TRIES):
            if named := claim.read_bytes().decode():
                break
            time.sleep(0.1)
        else:  # who made it died before it wrote
            named = secrets.token_hex(16)
        described = {**description, "id": named}
        write_json(self.path / "store.json", described, levels=0)
        return described

    def run(self, name: str) -> Run:
        """The run called ``name``, whether it exists or not. Raises StoreError for a name that can't be a directory."""
        check_name("run", name, StoreError)
        return Run(self.path / "runs" / name)

    @property
    def models(self) -> Path:
        return self.path / "models"

    @property
    def texts(self) -> Path:
        return self.path / "texts"

    def runs(
        self, after: str = "", most: int | None = None, among: Callable[[Run], bool] = lambda run: True
    ) -> list[Run]:
        """The existing runs, by name: those after ``after``, at most ``most``, of which ``among`` is true."""
        try:
            entries = sorted(name for name in os.listdir(self.path / "runs") if name > after and NAME.fullmatch(name))
        except FileNotFoundError:
            return []
        named = map(self.run, entries)
        return list(islice((run for run in named if os.path.lexists(run.path / "run.json") and among(run)), most))


def names_in(directory: Path) -> list[str]:
    """The valid names in a directory of the store, sorted; none if the directory does not exist.

    Raises:
        DamagedFile: The directory is a link.
        OSError: It can't be read.
    """
    refuse_links(directory, 1)
    try:
        entries = os.listdir(directory)
    except FileNotFoundError:
        return []
    return sorted(name for name in entries if NAME.fullmatch(name))
