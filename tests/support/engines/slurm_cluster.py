"""A real Slurm on this machine: slurmctld and three slurmd, each node with an address of its own; everything below one directory.

Needs Debian's ``slurm-wlm`` (or any Slurm that was built with multiple slurmd support), no root, no munge, no service.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import shutil
import signal
import socket
import stat
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.hosts import free_ports
from tests.support.processes import command, environment, processes_running, signal_all
from tests.support.waiting import PATIENCE, wait_for

NODES = ("n1", "n2", "n3")
CPUS, MEMORY, GPUS = 4, 8192, 2
"""What each node says that it has."""
_DAEMONS = "/usr/sbin:/usr/local/sbin:/opt/slurm/sbin"

_CONFIGURATION = """
ClusterName=muster-test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/none
CredType=cred/none
MpiDefault=none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=2,bf_interval=2,batch_sched_delay=0
PriorityType=priority/multifactor
PreemptType=preempt/partition_prio
PreemptMode=CANCEL
SlurmdParameters=config_overrides
StateSaveLocation={home}/state
SlurmdSpoolDir={home}/spool-%n
SlurmctldPidFile={home}/slurmctld.pid
SlurmdPidFile={home}/%n.pid
SlurmctldLogFile={home}/slurmctld.log
SlurmdLogFile={home}/%n.log
SlurmctldTimeout=30
SlurmdTimeout=5
MessageTimeout=5
KillWait=5
MinJobAge=300
InactiveLimit=0
ReturnToService=2
OverTimeLimit=0
GresTypes=gpu
{nodes}
PartitionName=debug Nodes=ALL Default=YES MaxTime=INFINITE DefaultTime={default_time} State=UP PriorityTier=1 PreemptMode=CANCEL GraceTime=20
PartitionName=urgent Nodes=ALL MaxTime=INFINITE State=UP PriorityTier=10 PreemptMode=OFF
PartitionName=short Nodes=ALL MaxTime=1 State=UP PriorityTier=1
PartitionName=closed Nodes=ALL MaxTime=INFINITE State=DOWN
"""


class SlurmCluster:
    """The daemons, and where their configuration is."""

    def __init__(self, home: Path, default_time: str = "INFINITE") -> None:
        self.home = home
        self.conf = home / "slurm.conf"
        self.daemons: dict[str, subprocess.Popen[bytes]] = {}
        (home / "state").mkdir(parents=True)
        (home / "devices").mkdir()
        ports = free_ports(1 + len(NODES))
        octet = os.getpid() % 250 + 1
        self.addresses = {name: f"127.{octet}.{ports[0] % 250 + 1}.{number}" for number, name in enumerate(NODES, 1)}
        nodes = [
            f"NodeName={name} NodeHostname={socket.gethostname()} NodeAddr={self.addresses[name]} Port={port} "
            f"CPUs={CPUS} RealMemory={MEMORY} Gres=gpu:{GPUS} State=UNKNOWN"
            for name, port in zip(NODES, ports[1:], strict=True)
        ]
        self.conf.write_text(
            _CONFIGURATION.format(
                host=socket.gethostname(),
                port=ports[0],
                user=pwd.getpwuid(os.geteuid()).pw_name,
                home=home,
                nodes="\n".join(nodes),
                default_time=default_time,
            )
        )
        gpus = f"{home}/devices/gpu[0-{GPUS - 1}]"
        try:
            for number in range(GPUS):  # what Slurm hands out are device files, whatever is behind them
                os.mknod(home / "devices" / f"gpu{number}", 0o666 | stat.S_IFCHR, os.makedev(1, 3))
        except PermissionError:
            gpus = f"/dev/tty[0-{GPUS - 1}]"
        (home / "gres.conf").write_text(f"NodeName={','.join(NODES)} Name=gpu File={gpus}\n")

    # -- daemons ------------------------------------------------------------------------------------------------------

    def start(self, *names: str) -> None:
        """Start ``slurmctld`` or nodes by name; all of them by default."""
        for name in names or ("slurmctld", *NODES):
            program = "slurmctld" if name == "slurmctld" else "slurmd"
            command = [program, "-D", "-f", str(self.conf)] + (["-N", name] if program == "slurmd" else [])
            with open(self.home / f"{name}.out", "ab") as output:
                self.daemons[name] = subprocess.Popen(
                    command, env=self.environment(), stdin=subprocess.DEVNULL, stdout=output, stderr=output
                )

    def kill(self, name: str, number: int = signal.SIGKILL) -> None:
        """End one daemon as a crash would."""
        self.daemons[name].send_signal(number)
        self.daemons[name].wait()

    def ready(self) -> None:
        """Wait until all nodes are idle."""

        def idle() -> bool:
            for name, daemon in self.daemons.items():
                assert daemon.poll() is None, f"{name} ended: {(self.home / f'{name}.out').read_text()[-500:]}"
            reported = self.run("sinfo", "-h", "-p", "debug", "-N", "-o", "%T", check=False).split()
            return reported == ["idle"] * len(NODES)

        wait_for(idle, 30, "all nodes are idle")

    def begin_anew(self) -> None:
        """Restart all daemons with an empty state, so that a test which broke the cluster does not fail the next one."""
        self.close()
        shutil.rmtree(self.home / "state")
        (self.home / "state").mkdir()
        self.start()
        self.ready()

    def close(self) -> None:
        """End every job, every daemon, and every process that they left."""
        if self.daemons and self.daemons["slurmctld"].poll() is None:
            self.run("scancel", "--user", pwd.getpwuid(os.geteuid()).pw_name, check=False)
            deadline = time.monotonic() + 10
            while self.run("squeue", "-h", check=False) and time.monotonic() < deadline:
                time.sleep(0.1)
        for daemon in self.daemons.values():
            if daemon.poll() is None:
                daemon.terminate()
        for daemon in self.daemons.values():
            try:
                daemon.wait(10 * PATIENCE)
            except subprocess.TimeoutExpired:
                daemon.kill()
                daemon.wait()
        signal_all(self.processes(), signal.SIGKILL)

    # -- looking ------------------------------------------------------------------------------------------------------

    def environment(self) -> dict[str, str]:
        return {**os.environ, "SLURM_CONF": str(self.conf), "PATH": f"{os.environ.get('PATH', '')}:{_DAEMONS}"}

    def run(self, *command: str, check: bool = True) -> str:
        """A Slurm command's output."""
        done = subprocess.run(command, env=self.environment(), capture_output=True, text=True, timeout=30 * PATIENCE)
        assert done.returncode == 0 or not check, f"{command}: {done.stderr}"
        return done.stdout.strip()

    def shown(self) -> str:
        """The cluster's nodes, jobs and processes, as text for an error message."""
        answers = [
            self.run(*words, check=False) for words in (("sinfo", "-N", "-o", "%N %T %E"), ("squeue", "-t", "all"))
        ]
        return "\n".join([*answers, *(" ".join(command(pid)) for pid in self.processes())])

    def processes(self, text: str = "") -> list[int]:
        """Pids of all that belongs to this cluster: daemons, steps, and what runs in them; with ``text`` in their command."""

        def is_mine(pid: int) -> bool:
            # slurmstepd has its node's name or its job's in its command, and no environment
            return environment(pid).get("SLURM_CONF") == str(self.conf) or str(self.home) in "\0".join(command(pid))

        return [pid for pid in processes_running(text) if is_mine(pid)]


@contextlib.contextmanager
def started(home: Path, **options: str) -> Iterator[SlurmCluster]:
    """A cluster whose nodes are all idle; nothing of it is left in the end."""
    need_slurm()
    cluster = SlurmCluster(home, **options)
    try:
        cluster.start()
        cluster.ready()
        yield cluster
    finally:
        cluster.close()
    assert not cluster.processes()


def need_slurm() -> None:
    """Skip loudly where there is none."""
    where = f"{os.environ.get('PATH', '')}:{_DAEMONS}"
    programs = ("slurmctld", "slurmd", "sbatch", "squeue", "scontrol", "scancel", "sinfo", "srun")
    if missing := [program for program in programs if not shutil.which(program, path=where)]:
        pytest.skip(f"NO SLURM: the slurm engine is not tested ({', '.join(missing)} not installed; Debian: slurm-wlm)")
