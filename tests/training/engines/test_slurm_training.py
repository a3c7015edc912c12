"""A training on Slurm: the loss of a node whose ranks live on, of the controller, and the same bits as on the local engine."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shared_store.volume.layout import Store
from shared_store.volume.metrics import read_metrics
from tests.conftest import Serving, wait_for
from tests.support.engines.slurm_cluster import SlurmCluster, started
from tests.support.engines.training import same_bits, submit
from tests.support.processes import processes_of_job, signal_all

long = pytest.mark.skipif(not os.environ.get("MUSTER_LONG"), reason="minutes: MUSTER_LONG=1, in make bits")


@pytest.fixture
def cluster(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SlurmCluster]:
    with started(tmp_path / "slurm", **getattr(request, "param", {})) as found:
        monkeypatch.setenv("SLURM_CONF", str(found.conf))
        yield found


@long
def test_it_survives_the_loss_of_a_node_and_of_the_controller_with_the_bits_of_the_local_engine(
    cluster: SlurmCluster, tmp_path: Path
) -> None:
    home = tmp_path / "home"
    home.mkdir()
    slurm = Serving(home, "--engine", "slurm")
    run = Store(home / "store").run("queued")
    local: Serving | None = None
    try:
        job = submit(slurm, "queued", "slurm", 24)
        wait_for(lambda: len(read_metrics(run)) >= 6, 120, "some iterations")
        # the main node is on n1; n2 hangs with all that is on it, as a machine that swaps does
        frozen = set(processes_of_job(job, SLURMD_NODENAME="n2"))
        assert len(frozen) >= 2, "supervisor and rank"
        signal_all(frozen, signal.SIGSTOP)
        cluster.kill("n2")
        # meanwhile the same on the local engine, undisturbed
        local = Serving(tmp_path / "local", "--store", str(home / "store"), "--cpus", "4")
        other = submit(local, "unqueued", "local", 24)
        wait_for(lambda: len(slurm.detail(job)["attempts"]) == 2, 60, "the loss is noticed")
        assert frozen <= set(processes_of_job(job, SLURMD_NODENAME="n2")), "what ran there is still there"
        slurm.kill()
        slurm.start()
        wait_for(lambda: slurm.detail(job)["status"] == "RUNNING", 60, "it runs again")
        signal_all(frozen, signal.SIGCONT)
        done = slurm.wait(job, timeout=180)
        assert done["status"] == "SUCCEEDED", (done["statusReason"], slurm.log(job)[-20:])
        assert [attempt["number"] for attempt in done["attempts"]] == [1, 2], done["attempts"]
        assert any("resumed from checkpoint" in line for line in slurm.log(job))
        wait_for(lambda: not cluster.processes("worker."), 30, "no process is left")
        assert local.wait(other, timeout=180)["status"] == "SUCCEEDED"
    finally:
        slurm.close()
        if local is not None:
            local.close()
    same_bits(home / "store", "queued", "unqueued")


@long
@pytest.mark.parametrize("cluster", [{"default_time": "2"}], indirect=True)
def test_at_the_time_limit_it_saves_leaves_and_is_submitted_anew(cluster: SlurmCluster, tmp_path: Path) -> None:
    """Two minutes a submission: the notice comes up to a minute after the start, which the iterations must outlast."""
    taken_back(tmp_path, iterations=1500)


@long
def test_when_it_is_preempted_it_saves_leaves_and_is_submitted_anew(cluster: SlurmCluster, tmp_path: Path) -> None:
    def preempt() -> None:
        script = ["--nodes=3", "--cpus-per-task=4", "--output=/dev/null", "--wrap", "sleep 5"]
        cluster.run("sbatch", "--partition=urgent", *script)

    taken_back(tmp_path, iterations=150, then=preempt)


def taken_back(tmp_path: Path, iterations: int, then: Callable[[], None] = lambda: None) -> None:
    """A training that Slurm ends in between, by ``then`` or by itself: no iteration is lost."""
    home = tmp_path / "home"
    home.mkdir()
    slurm = Serving(home, "--engine", "slurm")
    run = Store(home / "store").run("taken")
    try:
        job = submit(slurm, "taken", "slurm", iterations, "checkpoint.every=100000")
        wait_for(lambda: len(read_metrics(run)) >= 6, 120, "some iterations")
        then()
        done = slurm.wait(job, timeout=300)
        assert done["status"] == "SUCCEEDED", (done["statusReason"], slurm.log(job)[-20:])
        first = done["attempts"][0]
        assert (first["exitCode"], first["statusReason"]) == (75, "checkpointed and left on request"), first
        assert len(done["attempts"]) >= 2
        left = slurm.log(job)
        assert any("resumed from checkpoint" in line for line in left), left[-20:]
        numbers = [record["iteration"] for record in read_metrics(run)]
        assert numbers == sorted(set(numbers)) and len(numbers) == iterations, "no iteration was done twice"
    finally:
        slurm.close()
