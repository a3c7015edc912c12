"""Gangs of real processes on Gloo: N ranks compute what one computes, and a rank that never came is named."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
import torch.distributed as dist

from shared_store.volume.epoch import raise_epoch
from shared_store.volume.layout import Store
from tests.conftest import PATIENCE
from tests.support.worker.loop import iterate, setting_of
from tests.support.worker.point_task import Point, PointConfig, PointPPO
from tests.support.worker.ranks import ROOT, free_port, run_ranks, start_rank, training
from worker.learning.algorithm import WorldShare
from worker.learning.distributed import Gang, RankPlacement, _listen, connect, require_gpus
from worker.learning.ppo.fused import PPO
from worker.settings.errors import GangError

WORLDS = 7  # two ranks get 3 and 4


def learn() -> int:
    """Body of a rank: saves what it computed to ``MUSTER_OUT``."""
    torch.set_num_threads(1)
    gang = connect(RankPlacement.from_env(os.environ))
    torch.save(compute(gang), f"{os.environ['MUSTER_OUT']}.{gang.rank}")
    gang.close()
    return 0


def compute(gang: Gang) -> list[dict[str, torch.Tensor]]:
    """Three iterations, each of several passes over several minibatches."""
    share = WorldShare.of(gang.rank, gang.size, WORLDS)
    config = PointPPO(epochs=3, minibatches=4)
    task = Point(PointConfig(ppo=config), share.count, seed=2, first_world=share.first)
    task.set_random_episode_length()
    torch.manual_seed(7)
    ppo, found = PPO(config, setting_of(task, 4, gang, share)), []
    for iteration in range(3):
        metrics = iterate(ppo, task, iteration, iteration + 1)
        norm = ppo.actor.obs_normalizer
        found.append(
            {
                "metrics": torch.stack(list(metrics.values())).clone(),
                "gradients": torch.cat(ppo._gradients).clone(),
                "moments": torch.cat((norm._mean, norm._var, norm._std)).clone(),
                "count": norm.count.clone(),
                "weights": torch.cat([p.detach().flatten() for p in ppo.actor.parameters()]).clone(),
                "time_outs": gang.sum(ppo.rollout.time_outs.sum()),
            }
        )
    return found


@pytest.fixture(scope="module")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[int, int], list[dict[str, torch.Tensor]]]:
    """What each rank of a gang of one and of a gang of two computed, by (ranks, rank)."""
    folder = tmp_path_factory.mktemp("learnt")
    found = {(1, 0): compute(connect(RankPlacement(), device="cpu"))}
    for code, _, errors in run_ranks("training.worker.test_distributed:learn", 2, {"MUSTER_OUT": str(folder / "two")}):
        assert code == 0, errors
    return found | {(2, rank): torch.load(folder / f"two.{rank}", weights_only=True) for rank in (0, 1)}


def test_two_ranks_compute_what_one_does(learnt: dict) -> None:
    assert sum(float(found["time_outs"]) for found in learnt[1, 0]) > 0, "the example has no time-out"
    for one, two in zip(learnt[1, 0], learnt[2, 0], strict=True):
        torch.testing.assert_close(two["moments"], one["moments"], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(two["gradients"], one["gradients"], rtol=1e-3, atol=1e-6)
        torch.testing.assert_close(two["metrics"], one["metrics"], rtol=1e-3, atol=1e-5)
        torch.testing.assert_close(two["weights"], one["weights"], rtol=1e-3, atol=1e-5)
        assert two["count"] == one["count"]
        assert two["time_outs"] == one["time_outs"]


def test_all_ranks_hold_the_same_bits(learnt: dict) -> None:
    for main, other in zip(learnt[2, 0], learnt[2, 1], strict=True):
        for key in main:
            assert torch.equal(main[key], other[key]), key


def test_a_missing_rank_is_named_by_all() -> None:
    env = {"MUSTER_REPORT_SECONDS": "2"}
    port = free_port()
    processes = [start_rank("training.worker.test_distributed:report", rank, 3, port, env) for rank in (0, 1)]
    for process in processes:
        _, errors = process.communicate(timeout=60 * PATIENCE)
        assert process.returncode == 1
        assert "error: rank 2 (node 2) did not report within 2 s: 2 of 3 ranks are here" in errors
        assert "Traceback" not in errors


def report() -> int:
    """Body of a rank that only forms the gang."""
    connect(RankPlacement.from_env(os.environ), report_seconds=float(os.environ["MUSTER_REPORT_SECONDS"]))
    return 0


def test_a_missing_main_rank_is_named() -> None:
    placement = RankPlacement(rank=1, world_size=2, master_port=free_port())
    output = r"rank 1 \(node 1\) could not reach rank 0 \(node 0\) at 127.0.0.1:\d+ within 1 s"
    with pytest.raises(GangError, match=output):
        connect(placement, report_seconds=1.0)


MAIN_RANK_ENDED = "error: the main rank ended or did not answer in time; its log gives the reason"


def test_ranks_whose_main_rank_ends_at_the_resume_report_it_in_one_line(tmp_path: Path) -> None:
    raise_epoch(Store(tmp_path).run("run"), 2)
    (main, _, reason), (other, _, errors) = run_ranks("train", 2, training(tmp_path, epoch=1))
    assert main == other == 1 and "now belongs to epoch 2" in reason
    assert MAIN_RANK_ENDED in errors
    assert "Traceback" not in reason + errors


def end_while_building() -> int:
    """Body of a rank: the main rank exits during its build, while the other one waits for it."""
    gang = connect(RankPlacement.from_env(os.environ))
    with gang.in_turn("task"):
        if gang.is_main:
            os._exit(1)
    return 0


def test_a_rank_whose_main_rank_ends_while_it_builds_reports_it_in_one_line() -> None:
    _, (code, _, errors) = run_ranks("training.worker.test_distributed:end_while_building", 2)
    assert code == 1 and MAIN_RANK_ENDED in errors
    assert "Traceback" not in errors


def test_a_port_in_use_is_named() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(GangError, match=rf"rank 0 can't listen on 127.0.0.1:{port} .*set MASTER_PORT"):
            _listen("127.0.0.1", port)


def test_ranks_that_torchrun_starts_meet_at_its_store(tmp_path: Path) -> None:
    script = tmp_path / "ranks.py"
    script.write_text(
        "import os, torch\n"
        "from worker.learning.distributed import RankPlacement, connect\n"
        "gang = connect(RankPlacement.from_env(os.environ), device='cpu')\n"
        "total = gang.sum(torch.tensor([gang.rank + 1.0])).item()\n"
        # one write each: two ranks share this pipe
        "os.write(1, f\"sum {total} {gang.broadcast_text('from 0' if gang.is_main else None)}\\n\".encode())\n"
        "gang.close()\n"
    )
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", str(script)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60 * PATIENCE, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("sum 3.0 from 0") == 2


def test_the_store_listens_on_the_main_nodes_address_alone() -> None:
    port = free_port()
    os.close(held := _listen("127.0.0.1", port))
    held = _listen("127.0.0.1", port)
    try:
        with socket.socket() as other, pytest.raises(ConnectionRefusedError):
            other.connect(("127.0.0.2", port))
    finally:
        os.close(held)


def in_turn(sites: list[str]) -> list[tuple[str, int]]:
    """Two ranks, as threads, in a block; the order in which they enter and leave. Those that need not wait meet inside."""
    store, events = dist.HashStore(), []
    meeting = threading.Barrier(1 if sites[0] == sites[1] else 2)

    def rank(number: int) -> None:
        gang = Gang(RankPlacement(rank=number, world_size=2), "cpu", store, sites)
        with gang.in_turn("task"):
            events.append(("start", number))
            time.sleep(0.1)  # in which one that does not wait would come, too
            meeting.wait(20 * PATIENCE)
            events.append(("end", number))
        with gang.in_turn("task"):  # only the first time
            pass

    threads = [threading.Thread(target=rank, args=(number,)) for number in (1, 0)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return events


def test_one_rank_of_a_kernel_cache_goes_first() -> None:
    assert in_turn(["host:cache"] * 2) == [("start", 0), ("end", 0), ("start", 1), ("end", 1)]


def test_no_rank_waits_for_another_hosts_cache() -> None:
    assert [kind for kind, _ in in_turn(["a:cache", "b:cache"])] == ["start", "start", "end", "end"]


@pytest.mark.parametrize(
    ("env", "message"),
    [
        ({"RANK": "x"}, "RANK is 'x', not an integer"),
        ({"RANK": "2", "WORLD_SIZE": "2"}, "RANK is 2 in a WORLD_SIZE of 2"),
    ],
)
def test_a_malformed_placement_is_refused(env: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RankPlacement.from_env(env)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this PyTorch can use a GPU")
def test_a_rank_whose_gpu_pytorch_cannot_use_does_not_train_on_the_cpu_in_silence() -> None:
    for none in ("", "-1", "NoDevFiles"):
        require_gpus(none, 0)
    output = r"this node has GPU 0,1, and PyTorch .* can use none of them; install a PyTorch"
    with pytest.raises(ValueError, match=output):
        require_gpus("0,1", 1)
