"""A training on a second Muster that plays AWS: a rank that is killed, and the same bits as on the local engine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from orchestrator import specfile
from orchestrator.definition import compile_definition, compile_submission
from orchestrator.engines.aws_config import AwsConfig, save_config
from shared_store.layout import Store
from shared_store.metrics import read_metrics
from tests.conftest import REPOSITORY, Serving, processes_of, wait_for

CHANGES = ("nodes=2", "train.iterations=24", "train.worlds=16", "checkpoint.every=4", "resources.cpus=0.5")


def submit(serving: Serving, run: str) -> str:
    """Cart-pole on two nodes as run ``run``; returns the job id."""
    spec = specfile.load(str(REPOSITORY / "job_specs" / "cartpole.yaml"), list(CHANGES))
    request = compile_definition(spec, str(REPOSITORY))
    ours = {"MUSTER_RUN": run, "WARP_CACHE_PATH": os.environ["WARP_CACHE_PATH"]}
    container = request["nodeProperties"]["nodeRangeProperties"][0]["container"]
    container["environment"] += [{"name": name, "value": value} for name, value in ours.items()]
    arn = serving.client.batch("RegisterJobDefinition", **request)["jobDefinitionArn"]
    job: str = serving.client.batch("SubmitJob", **compile_submission(spec, arn))["jobId"]
    return job


@pytest.mark.skipif(not os.environ.get("MUSTER_LONG"), reason="a minute: MUSTER_LONG=1, in make bits")
def test_it_survives_the_loss_of_a_rank_with_the_bits_of_the_local_engine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "any")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "any")
    aws, home, volume = Serving(tmp_path / "aws", "--cpus", "4"), tmp_path / "home", Store(tmp_path / "efs").open()
    told = {"store": str(volume.path), "store_is_shared": False, "poll": 0.2, "quiet": 1.0}
    save_config(home, AwsConfig("us-east-1", "default", "muster", endpoint_url=aws.url, **told))
    laptop = Serving(home, "--engine", "aws-batch")
    run = volume.run("flown")
    try:
        job = submit(laptop, "flown")
        wait_for(lambda: run.path.exists() and len(read_metrics(run)) >= 6, 120, "some iterations")
        ranks = [pid for pid in processes_of(volume.path) if _is_rank(pid, 1)]
        os.kill(ranks[0], signal.SIGKILL)
        done = laptop.wait(job, timeout=240)
        assert done["status"] == "SUCCEEDED", (done["statusReason"], laptop.log(job)[-20:])
        assert len(done["attempts"]) == 2 and "rank 1 was killed by SIGKILL" in done["attempts"][0]["statusReason"]
        assert any("resumed from checkpoint" in line for line in laptop.log(job)), "its log is on the laptop"
    finally:
        laptop.close()
        aws.close()
    local = Serving(tmp_path / "local", "--cpus", "4", "--store", str(volume.path))
    try:
        assert local.wait(submit(local, "grounded"), timeout=240)["status"] == "SUCCEEDED"
    finally:
        local.close()
    compared = subprocess.run(
        [sys.executable, "-P", "-m", "worker.compare", "flown", "grounded"],
        env={**os.environ, "MUSTER_STORE": str(volume.path)},
        capture_output=True,
        text=True,
    )
    assert compared.returncode == 0 and compared.stdout.startswith("equal: "), compared.stdout + compared.stderr


def _is_rank(pid: int, rank: int) -> bool:
    return f"RANK={rank}".encode() in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
