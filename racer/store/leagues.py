"""Leagues of the racer: ``leagues/<name>/``, races of registered models under one set of rules; a league is immutable.

``definition/`` has the rules (``league.json``), ``entries/<number>/`` a model, its evaluation and its race (``entry.json``),
``disqualified/<number>/`` the reason why an entry does not count (``ruling.json``); each has a manifest of digests
(:mod:`shared_store.volume.bundles`). Entries count up from 1 without a gap: a missing one was deleted. Each appears by a rename that fails if
its number exists, so simultaneous entries get different numbers. The digests show damage and edits, but they are not signatures:
anyone who can write the store can forge a whole entry; running its race again exposes that.
"""

from __future__ import annotations

import contextlib
import os
import re
import time
import uuid
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from racer.store import tracks
from racer.store.races import race_changes, rules_of
from racer.store.standings import BadRace, Contender, Ranking, read_race
from shared_store.contract.documents import DocumentError, parse
from shared_store.contract.error_text import counted, nearest, shown
from shared_store.volume import bundles
from shared_store.volume.bundles import DamagedBundle
from shared_store.volume.files import DamagedFile, read_json, refuse_links, write_json
from shared_store.volume.layout import Store, check_name, names_in

CAR: Mapping[str, Any] = {
    "control_hz": 15.0,
    "substeps": 4,
    "speed_lag": 0.2,
    "steering_lag": 0.05,
    "speed_factor": [1.0, 1.0],
    "steering_factor": [1.0, 1.0],
    "steering_offset": [0.0, 0.0],
    "friction": [0.0, 0.0],
    "stuck_steps": 15,
    "put_back": 1.0,
}
"""Settings of the tasks ``Racer…`` for every car of a new league, whatever its training used."""
_NUMBER = re.compile(r"[1-9][0-9]{0,8}")


class LeagueError(Exception):
    """A league or entry does not exist or was altered, or an entry can't be made; one line."""


class UnknownLeague(LeagueError):
    """The league or entry does not exist."""


@dataclass(frozen=True)
class Rules:
    """The rules of a race, as in its summary.

    Attributes:
        laps: Number of laps; each is a trial from the start line.
        continuous: Whether a car that leaves the road is put back and continues, with a penalty.
        off_track_penalty: Time added to a lap for leaving the road [s].
        crash_penalty: Time added for touching an obstacle [s].
        max_resets: Number of times that a car is put back in one lap.
        seconds: Limit of a lap's simulated time [s].
        ranking: The ranking criterion.
    """

    laps: int = 3
    continuous: bool = False
    off_track_penalty: float = 1.0
    crash_penalty: float = 1.0
    max_resets: int = 100
    seconds: float = 1200.0
    ranking: Ranking = "total"


@dataclass(frozen=True)
class League:
    """The definition of a league.

    Attributes:
        name: Its name.
        track: Names of the tracks; with several, lap n is driven on number (n - 1) modulo their count.
        rules: The rules of its races.
        seed: Seed of every race.
        owner: The key or the user that created it.
        created: Time of creation [Unix s].
        opens: Time from which races may start [Unix s]; None: at once.
        closes: Time from which no race may start [Unix s]; None: never.
        most_entries: Greatest number of entries of each key or user.
        track_digests: Digests of the tracks in the store.
        car: Settings of the task for every car.
    """

    name: str
    track: tuple[str, ...]
    rules: Rules
    seed: int
    owner: str
    created: float
    opens: float | None = None
    closes: float | None = None
    most_entries: int = 99
    track_digests: Mapping[str, str] = field(default_factory=dict)
    car: Mapping[str, Any] = field(default_factory=lambda: dict(CAR))

    def closed(self, when: float) -> str:
        """The reason why no race may start at ``when`` [Unix s]; empty if one may."""
        if self.opens is not None and when < self.opens:
            return f"league {self.name} opens at {moment(self.opens)}"
        if self.closes is not None and when >= self.closes:
            return f"league {self.name} closed at {moment(self.closes)}"
        return ""

    def misfit(self, summary: Mapping[str, Any]) -> str:
        """The first mismatch of an evaluation's summary with this league's rules, tracks, seed and car; empty without any."""
        race = summary.get("race")
        if not isinstance(race, Mapping):
            return "it is not a race"
        driven, ruled = race.get("rules"), rules_of(self.section())
        for key in sorted(ruled.keys() - {"ranking"}):  # which follows from the times
            value = driven.get(key) if isinstance(driven, Mapping) else None
            if not _same(value, ruled[key]):
                return f"its rules have {key} {shown(value)}, the league's {ruled[key]}"
        if summary.get("seed") != self.seed:
            return f"its seed is {shown(summary.get('seed'))}, the league's {self.seed}"
        config, own = summary.get("config"), race_changes(self.section())
        changes = config if isinstance(config, Mapping) else {}
        for key in sorted(changes.keys() | own.keys()):
            if key not in changes or key not in own or not _same(changes[key], own[key]):
                return f"its config.{key} is {shown(changes.get(key))}, the league's {shown(own.get(key))}"
        return ""

    def section(self) -> dict[str, Any]:
        """The section ``race`` of a job for a race in this league, without the run."""
        rules = {key: value for key, value in asdict(self.rules).items() if key not in ("laps", "ranking")}
        places = {"trials": self.rules.laps, "seed": self.seed, "track": list(self.track), "config": dict(self.car)}
        return {**places, **rules}

    def check_tracks(self, store: Store) -> None:
        """Raise LeagueError if a track of the store is missing, damaged or was replaced."""
        for name, digest in self.track_digests.items():
            if digest_of_track(store, name) != digest:
                raise LeagueError(f"league {self.name}: track {name} has changed since the league was created")


@dataclass(frozen=True)
class StoredLeague:
    """A league of the store."""

    store: Store
    path: Path

    @property
    def name(self) -> str:
        return self.path.name

    def definition(self) -> League:
        """Its sealed rules. Raises LeagueError if any part of them is altered or missing."""
        document = self._sealed(self.path / "definition", "league.json", f"league {self.name}")[0]
        try:
            found: League = parse(League, document, f"league {self.name}")
        except DocumentError as error:
            raise LeagueError(str(error)) from None
        if found.name != self.name:
            raise LeagueError(f"league {self.name}: its definition is that of league {found.name}")
        return found

    def digest(self) -> str:
        """SHA-256 of the definition's manifest. Raises LeagueError."""
        return self._sealed(self.path / "definition", "league.json", f"league {self.name}")[1]

    def numbers(self) -> range:
        """Numbers of all entries. Raises LeagueError."""
        try:
            refuse_links(self.path / "entries", 3)
            present = [int(name) for name in os.listdir(self.path / "entries") if _NUMBER.fullmatch(name)]
        except (DamagedFile, OSError) as error:
            raise LeagueError(f"league {self.name}: entries can't be read ({error})") from None
        return range(1, max(present, default=0) + 1)

    def entry(self, number: int) -> dict[str, Any]:
        """The sealed content of an entry, with its ``digest``. Raises UnknownLeague; LeagueError if it is altered."""
        self._check_number(number)
        what = f"league {self.name}: entry {number}"
        if not os.path.lexists(self.path / "entries" / str(number)):
            raise LeagueError(f"{what} is missing: it was deleted")
        found, digest = self._sealed(self.path / "entries" / str(number), "entry.json", what)
        if found.get("league") != {"name": self.name, "digest": self.digest()} or found.get("entry") != number:
            raise LeagueError(f"{what} was not made as this entry of this league")
        model = found.get("model")
        if not (
            isinstance(found.get("racer"), str)
            and isinstance(found.get("owner"), str)
            and isinstance(found.get("evaluation"), Mapping)
            and isinstance(model, Mapping)
            and isinstance(model.get("name"), str)
            and isinstance(model.get("version"), int)
        ):
            raise LeagueError(f"{what} names no racer, owner, model or evaluation")
        try:
            read_race(found.get("race"))
        except BadRace as error:
            raise LeagueError(f"{what}: {error}") from None
        return {**found, "digest": digest}

    def problem(self, number: int, error: LeagueError) -> str:
        """The words of an error of an entry, without the names of league and entry."""
        return str(error).removeprefix(f"league {self.name}: entry {number}").removeprefix(":").removeprefix(" ")

    def ruling(self, number: int) -> dict[str, Any] | None:
        """The ruling that disqualifies an entry; None without one. An altered ruling still disqualifies, and says that it is altered."""
        path = self.path / "disqualified" / str(number)
        if not os.path.lexists(path):
            return None
        try:
            return self._sealed(path, "ruling.json", f"league {self.name}: the ruling on entry {number}")[0]
        except LeagueError as error:
            return {"reason": str(error)}

    def contenders(self) -> list[Contender]:
        """All entries for the table, with a note in altered ones. Raises LeagueError if the league itself is altered."""
        found = []
        for number in self.numbers():
            ruling = self.ruling(number)
            reason = str(ruling.get("reason") or "no reason is given") if ruling else ""
            try:
                entry = self.entry(number)
            except LeagueError as error:
                found.append(Contender(number, "-", "-", None, reason, self.problem(number, error)))
                continue
            reference = f"{entry['model']['name']}@{entry['model']['version']}"
            found.append(Contender(number, entry["racer"], reference, read_race(entry["race"]), reason))
        return found

    def enter(self, entry: Mapping[str, Any]) -> dict[str, Any]:
        """Make the next entry, permanently.

        Args:
            entry: ``racer``, ``owner``, ``model`` (name, version, digest), ``evaluation`` (name, job, run) and ``race``.

        Returns:
            The entry, as :meth:`entry`.

        Raises:
            LeagueError: The owner has reached the limit of entries, the racer's name is another owner's, or the evaluation has
                already been entered.
            OSError: The volume is full or gone.
        """
        digest = self.digest()
        while True:
            number = len(self.numbers()) + 1
            self.admit(entry["owner"], entry["racer"], entry["evaluation"])
            whole = {**entry, "league": {"name": self.name, "digest": digest}, "entry": number, "entered": time.time()}
            with contextlib.suppress(FileExistsError):  # another process was faster: try the next number
                _seal(self.path / "entries" / str(number), "entry.json", whole)
                return self.entry(number)

    def disqualify(self, number: int, reason: str, by: str) -> None:
        """Disqualify an entry permanently, in a file beside it. Raises LeagueError if it is already disqualified, OSError."""
        self._check_number(number)
        try:
            ruling = {"entry": number, "reason": reason, "by": by, "time": time.time()}
            _seal(self.path / "disqualified" / str(number), "ruling.json", ruling)
        except FileExistsError:
            raise LeagueError(f"league {self.name}: entry {number} is disqualified already") from None

    def admit(self, owner: str, racer: str, evaluation: Mapping[str, Any] | None = None) -> None:
        """Raise LeagueError if ``owner`` may not make a further entry, not as ``racer``, or not with this evaluation."""
        own, most = 0, self.definition().most_entries
        for number in self.numbers():
            try:
                other = self.entry(number)
            except LeagueError:
                continue
            if other["evaluation"] == evaluation:
                raise LeagueError(f"league {self.name}: entry {number} has this evaluation already")
            if other["racer"] == racer and other["owner"] != owner:
                raise LeagueError(
                    f"league {self.name}: racer {racer} is another's, who made entry {number}; choose another name"
                )
            own += other["owner"] == owner
        if own >= most:
            made = counted(own, "entry", "entries")
            raise LeagueError(f"league {self.name}: {owner} has made {made}, as many as one may make")

    def _check_number(self, number: int) -> None:
        present = self.numbers()
        if number not in present:
            range_text = f"available: {'1 to ' if len(present) > 1 else ''}{len(present) or 'none'}"
            raise UnknownLeague(f"league {self.name}: entry {number} does not exist; {range_text}")

    def _sealed(self, folder: Path, name: str, what: str) -> tuple[dict[str, Any], str]:
        """The document in a sealed directory and the digest of its manifest. Raises LeagueError."""
        try:
            refuse_links(folder, 3)
            manifest = bundles.verify(folder)
            if list(manifest["files"]) != [name]:
                raise LeagueError(f"{what}: it has other files than {name}")
            document = read_json(folder / name)
        except (DamagedBundle, DamagedFile, OSError) as error:
            raise LeagueError(f"{what}: {bundles.reason(error, folder)}") from None
        if document is None:
            raise LeagueError(f"{what}: {name} is missing")
        return document, str(manifest["digest"])


def folder_in(store: Store) -> Path:
    """Where the leagues of a store are."""
    return store.path / "leagues"


def names(store: Store) -> list[str]:
    """Names of all leagues. Raises LeagueError for a link where the directory should be."""
    try:
        return names_in(folder_in(store))
    except (DamagedFile, OSError) as error:
        raise LeagueError(str(error)) from None


def find(store: Store, name: str) -> StoredLeague:
    """The league of that name. Raises UnknownLeague with the nearest name."""
    known = names(store)
    if name not in known:
        hint = nearest(name, known, "" if known else "none was created yet")
        raise UnknownLeague(f"league {name[:130]} does not exist; {hint}")
    return StoredLeague(store, folder_in(store) / name)


def create(store: Store, league: League) -> StoredLeague:
    """Create a league, permanently. Raises LeagueError for an invalid name or an existing league; OSError."""
    check_name("league", league.name, LeagueError)
    taken = LeagueError(f"league {league.name} exists already, and a league is never changed; choose another name")
    if league.name in names(store):
        raise taken
    path = folder_in(store) / league.name
    hidden = folder_in(store) / f".{uuid.uuid4().hex}.tmp"
    try:
        with bundles.hidden_folder(hidden):
            for folder in ("definition", "entries", "disqualified"):
                (hidden / folder).mkdir()
            _fill(hidden / "definition", "league.json", asdict(league))
            bundles.publish(hidden, path)
    except FileExistsError:  # another process was faster
        raise taken from None
    return StoredLeague(store, path)


def digest_of_track(store: Store, name: str) -> str | None:
    """Digest of a track of the store; None for a preset and for one drawn from a seed. Raises LeagueError if it does not exist."""
    if tracks.is_made(name):
        return None
    if name.startswith("random:"):
        raise LeagueError(
            f"track {shown(name)}: after random: stands an integer from 0 to {2**63 - 1}, such as random:7"
        )
    try:
        track = tracks.find(store, name, tracks.PRESETS)
        track.read()
        return str(track.facts().get("digest"))
    except tracks.TrackError as error:
        raise LeagueError(str(error)) from None


def problem_of_track(store: Store, name: str) -> str | None:
    """Why a track can't be driven on; None: it can."""
    try:
        digest_of_track(store, name)
    except LeagueError as error:
        return str(error)
    return None


def _same(value: Any, other: Any) -> bool:
    """Whether two values of a summary are the same: true is not 1."""
    return bool(value == other) and isinstance(value, bool) == isinstance(other, bool)


def moment(seconds: float) -> str:
    """A time [Unix s] as text, in UTC."""
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(seconds))


def _seal(path: Path, name: str, document: Mapping[str, Any]) -> None:
    """A new sealed directory with one document. Raises FileExistsError, OSError."""
    with bundles.hidden_folder(path.parent / f".{uuid.uuid4().hex}.tmp") as hidden:
        _fill(hidden, name, document)
        bundles.publish(hidden, path)


def _fill(folder: Path, name: str, document: Mapping[str, Any]) -> None:
    write_json(folder / name, document)
    bundles.seal(folder, {"created": time.time()})
    for file in folder.iterdir():
        file.chmod(0o444)
