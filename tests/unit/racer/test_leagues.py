"""Leagues in the store: created once, entered for good, and whatever is altered says so."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from racer.store import leagues, tracks
from racer.store.leagues import LeagueError, Rules, StoredLeague, UnknownLeague
from racer.store.standings import table
from shared_store.volume.bundles import seal
from shared_store.volume.files import write_json
from shared_store.volume.layout import Store
from tests.support.racer.leagues import CONFIG, entry, league, race, summary
from tests.support.shared_store.at_once import at_once


@pytest.fixture
def cup(store: Store) -> StoredLeague:
    return leagues.create(store, league())


def test_a_league_is_kept_as_it_was_created(store: Store) -> None:
    assert leagues.names(store) == []
    rules = Rules(laps=5, continuous=True, ranking="best")
    fields = league("cup", track=("oval", "hills"), rules=rules, closes=2000.0, track_digests={"hills": "ab"})
    created = leagues.create(store, fields)
    assert created.path == store.path / "leagues" / "cup" and leagues.names(store) == ["cup"]
    assert leagues.find(store, "cup").definition() == fields and fields.car == leagues.CAR
    files = [path for path in created.path.rglob("*") if path.is_file()]
    assert all(path.stat().st_mode & 0o222 == 0 for path in files), "nothing of it may be written"


def test_a_league_is_never_changed(store: Store, cup: StoredLeague, monkeypatch: pytest.MonkeyPatch) -> None:
    output = r"^league cup exists already, and a league is never changed; choose another name$"
    for _ in range(2):
        with pytest.raises(LeagueError, match=output):
            leagues.create(store, league(seed=8))
        monkeypatch.setattr(leagues, "names", lambda store: [])  # it looked before the other one was done
    assert cup.definition().seed == 7
    assert os.listdir(store.path / "leagues") == ["cup"], "nothing half made is left"


@pytest.mark.parametrize("name", ["", "..", "a/b", ".hidden", "a b", "x" * 129, "a\n"])
def test_a_name_that_can_be_no_directory_is_refused(store: Store, name: str) -> None:
    with pytest.raises(LeagueError, match=r"^league name .*: use letters, digits"):
        leagues.create(store, league(name))
    assert not (store.path / "leagues").exists()


def test_an_unknown_league_or_entry_is_reported_with_the_existing_ones(store: Store) -> None:
    with pytest.raises(UnknownLeague, match=r"^league cpu does not exist; none was created yet$"):
        leagues.find(store, "cpu")
    cup = leagues.create(store, league())
    with pytest.raises(UnknownLeague, match=r"^league cpu does not exist; did you mean cup\?$"):
        leagues.find(store, "cpu")
    with pytest.raises(UnknownLeague, match=r"^league cup: entry 1 does not exist; available: none$"):
        cup.entry(1)
    cup.enter(entry())
    with pytest.raises(UnknownLeague, match=r"^league cup: entry 2 does not exist; available: 1$"):
        cup.disqualify(2, "x", "user ada")


def test_entries_count_up_and_hold_the_submission(cup: StoredLeague) -> None:
    for number in (1, 2, 3):
        made = cup.enter(entry(version=number))
        assert made["entry"] == number and made["league"] == {"name": "cup", "digest": cup.digest()}
        assert {key: made[key] for key in entry()} == entry(version=number)
        assert made == cup.entry(number) and len(made["digest"]) == 64
    assert [each.model for each in cup.contenders()] == ["fast@1", "fast@2", "fast@3"]
    assert sorted(os.listdir(cup.path / "entries")) == ["1", "2", "3"], "nothing half made is left"


def alter(path: Path, old: bytes, new: bytes) -> None:
    path.chmod(0o644)
    path.write_bytes(path.read_bytes().replace(old, new))


def reseal_elsewhere(cup: StoredLeague) -> None:
    """An entry of another league, sealed well."""
    shutil.rmtree(cup.path / "entries" / "1")
    other = leagues.create(cup.store, league("other"))
    other.enter(entry())
    shutil.copytree(other.path / "entries" / "1", cup.path / "entries" / "1")


def link_entry(cup: StoredLeague) -> None:
    shutil.move(cup.path / "entries" / "1", cup.store.path / "elsewhere")
    os.symlink(cup.store.path / "elsewhere", cup.path / "entries" / "1")


ENTRY = Path("entries") / "1"


@pytest.mark.parametrize(
    ("change", "output"),
    [
        (
            lambda cup: alter(cup.path / ENTRY / "entry.json", b"12.5", b"11.5"),
            "entry 1: the content of entry.json was altered",
        ),
        (
            lambda cup: shutil.copytree(cup.path / "entries" / "2", cup.path / "entries" / "1", dirs_exist_ok=True),
            "entry 1 was not made as this entry of this league",
        ),
        (lambda cup: shutil.rmtree(cup.path / "entries" / "1"), "entry 1 is missing: it was deleted"),
        (reseal_elsewhere, "entry 1 was not made as this entry of this league"),
        (link_entry, "entry 1: .* links inside a run are not followed"),
        (lambda cup: (cup.path / ENTRY / "notes.txt").write_text("added"), "entry 1: notes.txt was added"),
    ],
)
def test_an_altered_entry_is_not_ranked_and_the_others_are(
    cup: StoredLeague, change: Callable[[StoredLeague], Any], output: str
) -> None:
    cup.enter(entry("ada", version=1))
    cup.enter(entry("bob", version=2, race=race([14.0, 14.0, 14.0])))
    for path in (cup.path / "entries").rglob("*.json"):
        path.chmod(0o644)
    change(cup)
    with pytest.raises(LeagueError, match=f"^league cup: {output}"):
        cup.entry(1)
    rows = table(cup.contenders(), "total")
    assert [(row.rank, row.entry, row.status) for row in rows] == [(1, 2, "ranked"), (None, 1, "altered")]
    assert rows[1].racer == "-" and rows[1].time is None
    message = rows[1].reason.partition(str(cup.path))[0]
    assert rows[1].reason and "entry 1" not in rows[1].reason and "cup" not in message
    assert cup.enter(entry("cat", version=3))["entry"] == 3, "its number is not given again"


def test_an_altered_league_has_no_ranking_and_accepts_no_entries(cup: StoredLeague) -> None:
    cup.enter(entry())
    alter(cup.path / "definition" / "league.json", b'"laps": 3', b'"laps": 1')
    for send in (cup.definition, cup.digest, lambda: cup.enter(entry(version=2))):
        with pytest.raises(LeagueError, match=r"^league cup: the content of league.json was altered"):
            send()
    assert [row.status for row in table(cup.contenders(), "total")] == ["altered"]


def test_new_rules_in_the_place_of_the_old_ones_leave_the_old_entries_behind(cup: StoredLeague) -> None:
    cup.enter(entry())
    shutil.rmtree(cup.path / "definition")
    (cup.path / "definition").mkdir()
    write_json(cup.path / "definition" / "league.json", asdict(league(seed=8)))
    seal(cup.path / "definition", {"created": 1.0})
    assert cup.definition().seed == 8
    with pytest.raises(LeagueError, match="entry 1 was not made as this entry of this league"):
        cup.entry(1)


def test_an_entry_that_is_sealed_but_is_none_is_refused(cup: StoredLeague) -> None:
    for change, output in (
        ({"racer": 5}, "names no racer, owner, model or evaluation"),
        ({"model": {"name": "fast"}}, "names no racer"),
        ({"race": {**race([12.0]), "trials": []}}, "race: expected rules.laps and as many trials"),
    ):
        path = cup.path / "entries" / "1"
        path.mkdir()
        whole = {**entry(), **change, "entry": 1, "league": {"name": "cup", "digest": cup.digest()}}
        write_json(path / "entry.json", whole)
        seal(path, {})
        with pytest.raises(LeagueError, match=f"^league cup: entry 1:? {output}"):
            cup.entry(1)
        shutil.rmtree(path)


def test_a_ruling_is_stored_beside_the_entry_and_made_only_once(cup: StoredLeague) -> None:
    cup.enter(entry())
    before = {path: path.read_bytes() for path in (cup.path / "entries").rglob("*") if path.is_file()}
    assert cup.ruling(1) is None
    cup.disqualify(1, "another car", "user ada")
    ruling = cup.ruling(1)
    assert ruling is not None and (ruling["reason"], ruling["by"]) == ("another car", "user ada")
    assert {path: path.read_bytes() for path in (cup.path / "entries").rglob("*") if path.is_file()} == before
    with pytest.raises(LeagueError, match=r"^league cup: entry 1 is disqualified already$"):
        cup.disqualify(1, "twice", "user ada")
    assert [(row.status, row.reason) for row in table(cup.contenders(), "total")] == [("disqualified", "another car")]
    alter(cup.path / "disqualified" / "1" / "ruling.json", b"another", b"no such")
    (row,) = table(cup.contenders(), "total")
    assert row.status == "disqualified"
    assert "the ruling on entry 1: the content of ruling.json was altered" in row.reason


def test_an_owner_has_a_limited_number_of_entries_and_a_unique_name(store: Store) -> None:
    cup = leagues.create(store, league(most_entries=2))
    cup.enter(entry("ada", version=1))
    with pytest.raises(LeagueError, match=r"^league cup: entry 1 has this evaluation already$"):
        cup.enter(entry("ada", version=1))
    output = r"^league cup: racer ada is another's, who made entry 1; choose another name$"
    with pytest.raises(LeagueError, match=output):
        cup.enter(entry("ada", owner="user eve", version=2))
    cup.enter(entry("second ada", owner="user ada", version=3))
    with pytest.raises(LeagueError, match=r"^league cup: user ada has made 2 entries, as many as one may make$"):
        cup.enter(entry("ada", version=4))
    assert cup.enter(entry("bob", version=5))["entry"] == 3 and len(cup.numbers()) == 3


def enter_five(path: str, number: str) -> list[int]:
    cup, fields = leagues.find(Store(path), "cup"), list[int]()
    for version in range(5):
        try:
            made = cup.enter(entry(f"r{number}", owner="user one", version=100 * int(number) + version))
            fields.append(made["entry"])
        except LeagueError as error:
            assert "as many as one may make" in str(error), error
    return fields


def test_processes_that_enter_at_once_get_a_number_each_and_no_more_than_are_allowed(store: Store) -> None:
    leagues.create(store, league(most_entries=8))
    fields = at_once(enter_five, [(str(store.path), number) for number in "012"])
    assert sorted(entry for each in fields for entry in each) == list(range(1, 9))


def test_a_league_is_open_from_its_first_moment_to_its_last_and_the_presets_are_those_of_the_racer() -> None:
    timed = league(opens=1000.0, closes=2000.0)
    assert timed.closed(999.9) == "league cup opens at 1970-01-01 00:16:40 UTC"
    assert timed.closed(1000.0) == timed.closed(1999.9) == ""
    assert timed.closed(2000.0) == "league cup closed at 1970-01-01 00:33:20 UTC"
    assert league().closed(0.0) == league().closed(1e12) == ""
    from racer.tracks.presets import PRESETS

    assert tuple(PRESETS) == tracks.PRESETS


@pytest.mark.parametrize(
    ("changes", "output"),
    [
        ({}, ""),
        ({"race": race([12.0, 12.0, 12.0], ranking="best")}, ""),
        ({"race": None}, "it is not a race"),
        ({"race": race([12.0])}, "its rules have laps 1, the league's 3"),
        ({"race": race([12.0] * 3, continuous=True)}, "its rules have continuous True, the league's False"),
        ({"race": race([12.0] * 3, continuous=0)}, "its rules have continuous 0, the league's False"),
        ({"race": race([12.0] * 3, off_track_penalty=0.5)}, "its rules have off_track_penalty 0.5, the league's 1.0"),
        ({"seed": 8}, "its seed is 8, the league's 7"),
        ({"config": {}}, "its config.alternate_direction is None, the league's False"),
        ({"config": {**CONFIG, "track": ["chicane"]}}, "its config.track is ['chicane'], the league's ['oval']"),
        ({"config": {**CONFIG, "speed_lag": 0.0}}, "its config.speed_lag is 0.0, the league's 0.2"),
        ({"config": {**CONFIG, "obstacles": []}}, "its config.obstacles is [], the league's None"),
        ({"config": {**CONFIG, "start": "random"}}, "its config.start is 'random', the league's 'line'"),
    ],
)
def test_an_evaluation_of_other_rules_is_not_of_the_league(changes: dict[str, Any], output: str) -> None:
    assert league().misfit(summary(race([12.0, 12.5, 13.0])) | changes) == output


def test_the_tracks_of_a_league_cannot_change(store: Store) -> None:
    assert leagues.digest_of_track(store, "oval") is None and leagues.digest_of_track(store, "random:7") is None
    with pytest.raises(LeagueError, match=r"^track ovel does not exist; did you mean oval\?$"):
        leagues.digest_of_track(store, "ovel")
    tracks.add(store, "hills", b"rows", {"digest": "first"})
    assert leagues.digest_of_track(store, "hills") == "first"
    hilly = league(track=("hills",), track_digests={"hills": "first"})
    hilly.check_tracks(store)
    shutil.rmtree(store.path / "tracks" / "hills")
    with pytest.raises(LeagueError, match=r"^track hills does not exist"):
        hilly.check_tracks(store)
    tracks.add(store, "hills", b"others", {"digest": "second"})
    with pytest.raises(LeagueError, match=r"^league cup: track hills has changed since the league was created$"):
        hilly.check_tracks(store)


def test_links_out_of_the_store_are_not_followed(store: Store, tmp_path: Path) -> None:
    leagues.create(store, league())
    shutil.rmtree(store.path / "leagues")
    os.symlink(tmp_path, store.path / "leagues")
    for send in (lambda: leagues.names(store), lambda: leagues.create(store, league("two"))):
        with pytest.raises(LeagueError, match="links inside a run are not followed"):
            send()
