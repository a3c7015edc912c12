"""Which store a database belongs to."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from orchestrator.control.store_identity import StoreIdentity, recognise
from orchestrator.persistence.batch_models import Attempt
from orchestrator.persistence.session import Database
from shared_store.volume.layout import Store, StoreError
from tests.support.orchestrator.rows import job


class Home:
    """A database in a directory of its own, and the path of its store."""

    def __init__(self, directory: Path, store: Path) -> None:
        directory.mkdir()
        self.database, self.store = Database.at(directory), Store(store)

    def start(self, adopt: bool = False) -> StoreIdentity:
        """As a controller's start does. Raises StoreError."""
        with self.database.session() as session:
            return recognise(session, self.store, adopt)

    def run(self, name: str) -> None:
        """Have the database know a run."""
        with self.database.session() as session:
            known = job(name)
            known.attempts = [Attempt(number=1, epoch=1, created_at=0)]
            session.add(known)


@pytest.fixture
def home(tmp_path: Path) -> Home:
    return Home(tmp_path / "home", tmp_path / "store")


def test_a_new_store_gets_an_identity_that_the_database_knows_from_then_on(home: Home) -> None:
    first = home.start()
    assert first.identity == home.store.identity() and first.problem() is None
    assert home.start() == first


def test_another_or_no_store_under_the_path_is_refused_until_it_is_adopted(home: Home, tmp_path: Path) -> None:
    mine = home.start()
    home.store.path.rename(tmp_path / "away")
    assert "there is no store" in (mine.problem() or "")
    with pytest.raises(StoreError, match=r"there is no store there; see whether.*--adopt-store"):
        home.start()
    home.store.path.mkdir()
    with pytest.raises(StoreError, match="there is no store there"):
        home.start()
    Store(home.store.path).open()
    assert "another store is at" in (mine.problem() or "")
    with pytest.raises(StoreError, match="another store is there"):
        home.start()
    assert home.start(adopt=True).identity != mine.identity
    shutil.rmtree(home.store.path)
    (tmp_path / "away").rename(home.store.path)
    with pytest.raises(StoreError, match="another store is there"):
        home.start()


@pytest.mark.parametrize("content", ["{}", "damaged"])
def test_the_store_of_an_older_muster_is_adopted_where_it_has_one_of_the_runs(home: Home, content: str) -> None:
    home.run("one")
    home.run("two")
    home.store.open()
    (home.store.path / "store.json").write_text(json.dumps({"format": 1}))
    with pytest.raises(StoreError, match="none of the runs of this controller's jobs is there"):
        home.start()
    assert home.store.identity() is None, "nothing is written"
    run = home.store.run("two").path
    run.mkdir(parents=True)
    (run / "run.json").write_text(content)
    assert home.start().identity == home.store.identity()


def test_a_store_that_can_t_be_read_is_one_line(home: Home) -> None:
    mine = home.start()
    (home.store.path / "store.json").write_text("{")
    assert "can't be read" in (mine.problem() or "")
    with pytest.raises(StoreError, match=r"store\.json can't be read"):
        home.start()
    with pytest.raises(OSError, match="can't be read"):
        mine.check()
