"""A volume that runs full: nothing new starts or is accepted, what runs can be stopped, all is reported, and all goes on with room."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from botocore.exceptions import ClientError
from sqlalchemy import func, select, update

from orchestrator.control.disk import DEFAULT, Disk, MinFree
from orchestrator.domain.errors import ApiError
from orchestrator.persistence.batch_models import JobQueue
from orchestrator.persistence.session import Database, DatabaseFull
from shared_store.volume.layout import Store
from shared_store.volume.metrics import MetricsWriter, read_metrics
from tests.conftest import PATIENCE, Serving, wait_for
from tests.support.conformance.streams import client_of
from tests.support.faults.full_disk import fill, small_volume
from tests.support.processes import processes_of

SLEEP = "import time; print('begun', flush=True); time.sleep(3000)"
FLOOD = "import os; os.execvp('timeout', ['timeout', '5', 'yes'])"


@pytest.fixture
def volume(tmp_path: Path) -> Iterator[Path]:
    """A volume of its own of 40 MB, in memory."""
    with small_volume(tmp_path / "volume", 40 << 20) as found:
        yield found


def free(volume: Path) -> int:
    found = os.statvfs(volume)
    return found.f_bavail * found.f_frsize


def test_on_a_full_volume_jobs_are_stopped_settled_and_refused_and_a_flood_does_not_fill_it(volume: Path) -> None:
    server = Serving(volume / "home", "--cpus", "2")
    with open(volume.parent / "stderr", "wb") as log:  # it must not fill its own pipe, nor the volume
        copying = subprocess.Popen(["cat"], stdin=server.process.stderr, stdout=log)
        try:
            sleeper = server.gang(SLEEP, name="sleeper")
            server.wait(sleeper, "RUNNING")
            flood = server.gang(FLOOD, name="flood")
            waiting = server.gang("print('at last')", name="waiting", cpus="1.95")
            server.wait(flood, "RUNNING")
            wait_for(lambda: any("left out" in line for line in server.log(flood)), 30, "more lines than the log keeps")
            assert free(volume) > 10 << 20, "a flood does not fill the volume"
            filler = fill(volume)
            wait_for(lambda: "MB free" in server.detail(waiting)["statusReason"], 60, "the reason of what waits")
            assert "--min-free" in server.detail(sleeper)["statusReason"], "a running job says so, too"

            batch = client_of(server.url, "batch")
            batch.terminate_job(jobId=sleeper, reason="make room")
            assert server.wait(sleeper)["statusReason"] == "make room"
            ended = server.wait(flood)
            assert ended["status"] == "FAILED" and ended["attempts"][0]["nodes"][0]["exitCode"] == 124, ended
            assert server.detail(waiting)["status"] == "RUNNABLE"
            with pytest.raises(ClientError, match="MB free") as refused:
                batch.submit_job(jobName="more", jobQueue="default", jobDefinition="sleeper")
            assert refused.value.response["ResponseMetadata"]["HTTPStatusCode"] == 503
            assert refused.value.response["Error"]["Code"] == "ServerException"
            with pytest.raises(ApiError, match="nothing new is accepted"):
                server.gang("pass", name="another")
            shown = server.muster("show", waiting)
            assert "MB free" in " ".join(shown.stdout.split()), shown.stdout

            filler.unlink()
            assert server.wait(waiting)["status"] == "SUCCEEDED" and "at last" in server.log(waiting)
            assert server.wait(server.gang("pass", name="another"))["status"] == "SUCCEEDED"
        finally:
            server.close()
            copying.wait(10 * PATIENCE)
    message = (volume.parent / "stderr").read_text()
    assert "Traceback" not in message and len(message) < 4000, message
    assert "MB free" in message and "the volumes answer again, and have enough free space" in message
    assert not processes_of(server.home)


def test_the_database_ends_jobs_on_a_volume_without_a_free_byte(volume: Path) -> None:
    database = Database.at(volume)
    with database.session() as session:
        session.add(JobQueue(name="q", priority=1, compute_environments=[], tags={}, limits=[]))
    fill(volume)
    for priority in range(2000):
        with database.session() as session:
            session.execute(update(JobQueue).values(priority=priority))
    with pytest.raises(DatabaseFull, match="its volume is full; make room there"), database.session() as session:
        for number in range(200):
            session.add(
                JobQueue(name=f"q{number}", priority=1, compute_environments=["x" * 100_000], tags={}, limits=[])
            )
    with database.session() as session:
        assert session.scalar(select(func.count()).where(JobQueue.name.startswith("q"))) == 1
    database.close()


def test_the_database_may_lie_on_another_volume_than_the_home(tmp_path: Path, volume: Path) -> None:
    server = Serving(tmp_path / "home", "--cpus", "1", "--database", str(volume / "jobs.db"))
    try:
        assert (volume / "jobs.db").exists() and not (tmp_path / "home" / "muster.db").exists()
        fill(volume)

        def refusal() -> str:
            try:
                server.gang("pass")
            except ApiError as error:
                return str(error)
            return ""

        message = wait_for(refusal, 20, "a look at the volume")
        assert re.search(r"the volume of the database \(.*volume\) has 0 MB free", message), message
    finally:
        server.close()


def test_a_minimum_is_a_size_a_share_or_nothing() -> None:
    assert DEFAULT.of(10 << 40) == 1 << 30 and DEFAULT.of(1 << 30) == (1 << 30) // 20
    assert MinFree.parse("512MiB").of(1) == 512 << 20 and MinFree.parse("2.5%").of(1000) == 25
    assert MinFree.parse("0").of(1 << 40) == 0
    for wrong in ("", "much", "1", "101%", "-1GiB", "1 EiB"):
        with pytest.raises(ValueError, match="expected a size such as 1GiB"):
            MinFree.parse(wrong)


def test_only_the_volume_that_is_short_is_named(tmp_path: Path) -> None:
    disk = Disk({"store": tmp_path, "database": tmp_path / "gone"}, MinFree(share=1.0))
    assert "the volume of the store" in str(disk.shortage()) and disk.shortage("database") is None


def test_metrics_wait_for_room_and_none_is_lost(tmp_path: Path) -> None:
    with small_volume(tmp_path / "volume", 1 << 20) as volume:
        run = Store(volume / "store").open().run("r")
        run.path.mkdir()
        writer = MetricsWriter(run, 1, 0)
        writer.write({"iteration": 1})
        filler = fill(volume)
        refused = 0
        for iteration in range(2, 400):
            try:
                writer.write({"iteration": iteration, "fill": "x" * 100})
            except OSError:
                refused += 1
        assert refused > 300, "what was left of its last block took a few"
        filler.unlink()
        writer.write({"iteration": 400})
        assert [each["iteration"] for each in read_metrics(run)] == list(range(1, 401))
        writer.close()


def test_a_full_store_keeps_no_text_nor_a_part_of_it_and_takes_it_with_room(volume: Path, tmp_path: Path) -> None:
    text = "half of it would fit\n" * 40_000
    with Serving(tmp_path / "home", "--store", str(volume / "store")) as server:
        filler = fill(volume)
        with pytest.raises(
            ApiError, match=r"the text is not kept$|the text can't be kept in .*No space left"
        ) as refused:
            server.client.keep_text(text)
        assert refused.value.status == 503
        assert [*volume.glob("store/texts/*/*")] == []
        filler.unlink()

        def keeps() -> bool:
            try:
                server.client.keep_text(text)
            except ApiError:  # the next look at the volume is to come
                return False
            return True

        wait_for(keeps, 30, "room for the text")
        (kept,) = volume.glob("store/texts/*/*")
        assert kept.read_text() == text
