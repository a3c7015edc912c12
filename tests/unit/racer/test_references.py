"""What the entries of leagues need of the store: the run that a race is cited of, and its job."""

from __future__ import annotations

import pytest

from racer.store import leagues
from shared_store.volume import plugin_folders
from shared_store.volume import references as module
from shared_store.volume.layout import Store
from shared_store.volume.references import references
from tests.support.permissions import permissions_count
from tests.support.racer.leagues import entry, league


def test_an_entry_needs_the_run_and_the_job_of_the_race_that_it_cites(store: Store) -> None:
    cup = leagues.create(store, league())
    cup.enter(entry("racer", "key a"))
    cited = cup.entry(1)["evaluation"]
    found, unreadable = references(store)
    by = "entry 1 of league cup cites it"
    assert {(each.kind, each.name, each.by) for each in found} == {("run", cited["run"], by), ("job", cited["job"], by)}
    assert unreadable == []


def test_an_entry_that_can_t_be_read_is_named_since_it_may_need_any_run(store: Store) -> None:
    cup = leagues.create(store, league())
    for number in ("1", "2"):
        (cup.path / "entries" / number).mkdir(parents=True)
    (cup.path / "entries" / "1" / "entry.json").write_text("[]")
    found, unreadable = references(store)
    assert found == []
    for part in ("entry 1 of league cup", "entry 2 of league cup"):
        assert any(part in each.why and each.whole for each in unreadable), (part, unreadable)


def test_a_league_that_can_t_be_read_hides_no_other(store: Store) -> None:
    leagues.create(store, league("bowl")).enter(entry("racer", "key a"))
    entries = leagues.create(store, league()).path / "entries"
    entries.mkdir(exist_ok=True)
    entries.chmod(0)
    with permissions_count():
        found, unreadable = references(store)
    entries.chmod(0o755)
    assert {each.by for each in found} == {"entry 1 of league bowl cites it"}
    assert any(each.why.startswith("league cup can't be read ([Errno 13]") for each in unreadable), unreadable


def test_without_the_racer_its_folders_may_need_any_run_and_any_job(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    leagues.create(store, league()).enter(entry("racer", "key a"))
    plugin_folders.note_plugins(store)
    for each in (plugin_folders, module):
        monkeypatch.setattr(each, "plugins", dict)
    found, [unreadable] = references(store)
    assert found == [] and unreadable.whole
    assert f"plug-in 'racer' is not installed, so what its folder {store.path / 'leagues'} needs" in unreadable.why
    (store.path / "tracks").mkdir()
    assert f"{store.path / 'tracks'} and {store.path / 'leagues'} need" in references(store)[1][0].why
