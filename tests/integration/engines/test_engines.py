"""Choosing an engine: mistakes are one line, before anything starts."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.engines.api import EngineError, Setting
from orchestrator.engines.installed import make_engine
from orchestrator.engines.ray.cluster import ray_environment
from orchestrator.engines.slurm import commands as slurm_commands
from orchestrator.engines.toolkit.mounts import Mount, with_mounts
from tests.conftest import call_muster
from tests.support.engines.slurm_cluster import need_slurm


def refused(home: Path, engine: str, code: int = 1, **env: str) -> str:
    """The one line with which ``muster serve`` is refused with an engine."""
    done = call_muster("serve", "--port", "0", "--engine", engine, home=home, **env)
    assert done.returncode == code and done.stderr.count("\n") == 1, done.stderr
    return done.stderr


def test_an_engine_that_is_not_there_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    assert refused(tmp_path, "dokcer", 2) == "muster: --engine dokcer: there is no such engine; did you mean docker?\n"
    assert not (tmp_path / "muster.db").exists()
    said = "muster: no Docker Engine answers (No such file or directory); start it (systemctl start docker), or set DOCKER_HOST\n"
    assert refused(tmp_path, "docker", DOCKER_HOST="unix:///nowhere.sock") == said
    said = refused(tmp_path, "slurm", PATH="/nowhere")
    assert said.startswith("muster: scontrol is not installed here: the slurm engine uses the cluster's own")


def test_without_slurm_s_controller_nothing_starts(tmp_path: Path) -> None:
    need_slurm()
    configuration = tmp_path / "slurm.conf"
    configuration.write_text(
        "ClusterName=away\nSlurmctldHost=localhost\nSlurmctldPort=1\nAuthType=auth/none\nCredType=cred/none\n"
        "NodeName=n1\nPartitionName=p Nodes=n1\nMessageTimeout=2\n"
    )
    said = refused(tmp_path, "slurm", SLURM_CONF=str(configuration))
    assert said.startswith("muster: slurmctld does not answer (") and said.endswith("see `scontrol ping`\n")


def test_a_missing_configuration_of_slurm_is_reported_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_slurm()
    if Path("/etc/slurm/slurm.conf").exists():
        pytest.skip("this machine belongs to a cluster")
    monkeypatch.delenv("SLURM_CONF", raising=False)
    bad = call_muster("doctor", "--engine", "slurm", home=tmp_path)
    assert bad.returncode == 1
    assert "Slurm is installed but has no configuration here: put the cluster's slurm.conf at /etc/slurm/" in bad.stdout
    bad = call_muster("doctor", "--engine", "slurm", home=tmp_path, SLURM_CONF="/no/slurm.conf")
    assert "SLURM_CONF is /no/slurm.conf, which is not there; set it to the cluster's slurm.conf" in bad.stdout


@pytest.mark.parametrize("engine", ["local", "ray"])
def test_an_engine_that_may_not_mount_says_so_by_its_name(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    said = f"^volume /mnt: the {engine} engine mounts only as root; start `muster serve`"
    with pytest.raises(EngineError, match=said):
        with_mounts(["true"], [Mount("/data", "/mnt")], engine)


@pytest.mark.parametrize(
    ("source", "target"),
    [
        ("-h", "/mnt"),
        ("--", "/mnt"),
        ("data", "/mnt"),
        ("/data", "--"),
        ("/data", "mnt"),
        ("/data", "/"),
        ("/a/../b", "/m"),
    ],
)
def test_source_and_target_of_a_mount_must_be_absolute_paths(source: str, target: str) -> None:
    with pytest.raises(EngineError, match=r"^volume .*: two absolute paths without '..' are needed$"):
        with_mounts(["true"], [Mount(source, target)])


def test_every_engine_is_made_by_its_name(tmp_path: Path) -> None:
    assert make_engine("local", Setting(tmp_path, cpus=2.0, gpus=["3"])).capacity().machines[0].gpus == ("3",)
    with pytest.raises(EngineError, match="there is no engine 'kubernetes'"):
        make_engine("kubernetes", Setting(tmp_path))


def test_jobs_inherit_no_secrets_of_other_engines_from_an_engine_s_commands(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "RAY_AUTH_TOKEN", "SLURM_JWT"):
        monkeypatch.setenv(name, "secret")
    assert {name for name, value in slurm_commands.environment().items() if value == "secret"} == {"SLURM_JWT"}
    found = {name for name, value in ray_environment("h:1").items() if value == "secret"}
    assert found == {"RAY_AUTH_TOKEN", "SLURM_JWT"}
