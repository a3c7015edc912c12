"""Choosing an engine: mistakes are one line, before anything starts."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.engines import ENGINES, make_engine
from orchestrator.engines.base import EngineError
from tests.conftest import run_muster
from tests.engines.slurm_cluster import need_slurm


def test_an_unknown_engine_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    refused = run_muster("serve", "--port", "0", "--engine", "dokcer", home=tmp_path)
    assert (
        refused.returncode == 1
        and refused.stderr == f"muster: there is no engine 'dokcer'; there are {', '.join(ENGINES)}\n"
    )
    assert not (tmp_path / "muster.db").exists(), "nothing was made"


def test_without_a_docker_engine_nothing_starts(tmp_path: Path) -> None:
    refused = run_muster(
        "serve", "--port", "0", "--engine", "docker", home=tmp_path, DOCKER_HOST="unix:///nowhere.sock"
    )
    assert refused.returncode == 1 and refused.stderr.count("\n") == 1, refused.stderr
    assert refused.stderr == (
        "muster: no Docker Engine answers (No such file or directory); start it (systemctl start docker), or set DOCKER_HOST\n"
    )


def test_without_slurm_s_commands_or_its_controller_nothing_starts(tmp_path: Path) -> None:
    refused = run_muster("serve", "--port", "0", "--engine", "slurm", home=tmp_path, PATH="/nowhere")
    assert refused.returncode == 1 and refused.stderr.count("\n") == 1, refused.stderr
    assert refused.stderr.startswith("muster: scontrol is not installed here: the slurm engine uses the cluster's own")
    need_slurm()
    configuration = tmp_path / "slurm.conf"
    configuration.write_text(
        "ClusterName=away\nSlurmctldHost=localhost\nSlurmctldPort=1\nAuthType=auth/none\nCredType=cred/none\n"
        "NodeName=n1\nPartitionName=p Nodes=n1\nMessageTimeout=2\n"
    )
    refused = run_muster("serve", "--port", "0", "--engine", "slurm", home=tmp_path, SLURM_CONF=str(configuration))
    assert refused.returncode == 1 and refused.stderr.count("\n") == 1, refused.stderr
    assert refused.stderr.startswith("muster: slurmctld does not answer (")
    assert refused.stderr.endswith("see `scontrol ping`\n")


def test_every_engine_is_made_by_its_name(tmp_path: Path) -> None:
    assert make_engine("local", tmp_path, cpus=2.0, gpus=["3"]).capacity()[0].gpus == ("3",)
    with pytest.raises(EngineError, match="there is no engine 'kubernetes'"):
        make_engine("kubernetes", tmp_path)
