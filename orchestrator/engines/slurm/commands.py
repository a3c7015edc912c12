"""Slurm's own commands: calling them, and a snapshot of its jobs that is at most a second old while it is used."""

from __future__ import annotations

import ipaddress
import os
import pwd
import re
import socket
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orchestrator.domain.hosts import Host
from orchestrator.engines.api import EngineError
from orchestrator.engines.toolkit.environment import inherited

_LIMIT = 30.0
"""Seconds after which a command has failed: Slurm's own patience with a controller that is away is a minute and more."""
_AWAY = re.compile(
    r"(?i)unable to contact|connection (refused|timed out)|socket timed out|not responding|zero bytes|try again"
)
_UNCONFIGURED = re.compile("Could not establish a configuration source|resolve_ctls_from_dns_srv")
_HOSTS_AGE = 10.0
"""Seconds for which a picture of all hosts holds."""
_AWAY_STATES = frozenset(
    {"DOWN", "DRAIN", "DRAINED", "DRAINING", "ERROR", "FAIL", "FAILING", "INVAL", "INVALID_REG"}
    | {"MAINT", "MAINTENANCE", "NOT_RESPONDING", "UNKNOWN"}
)
"""Words of a node's state that mean that nothing can start there now. ``POWERED_DOWN`` is none: Slurm boots such a node for a job."""


class Unreachable(EngineError):
    """slurmctld does not answer now; it may later."""


@dataclass(frozen=True)
class SlurmJob:
    """One job as ``squeue`` tells it."""

    number: str
    state: str
    reason: str
    hosts: str
    comment: str


def call(*command: str, text: str | None = None) -> str:
    """The output of one of Slurm's commands.

    Raises:
        Unreachable: slurmctld does not answer.
        EngineError: It refused, in its own words.
    """
    if (told := os.environ.get("SLURM_CONF")) and not os.path.exists(told):  # Slurm itself would try for a minute
        raise Unreachable(f"SLURM_CONF is {told}, which is not there; set it to the cluster's slurm.conf")
    try:
        done = subprocess.run(
            command, input=text, capture_output=True, text=True, timeout=_LIMIT, env=environment(), errors="replace"
        )
    except FileNotFoundError:
        raise EngineError(
            f"{command[0]} is not installed here: the slurm engine uses the cluster's own commands; "
            "start the controller on a login node, or install Slurm's client commands (Debian: slurm-client)"
        ) from None
    except OSError as error:  # no process or descriptor to be had
        raise Unreachable(f"can't run {command[0]} now: {error}") from None
    except subprocess.TimeoutExpired:
        raise Unreachable(
            f"slurmctld does not answer ({command[0]} waited {_LIMIT:g} s); see `scontrol ping`"
        ) from None
    if done.returncode == 0:
        return done.stdout
    said = [re.sub(r"^\w+: (error|fatal): ", "", line).strip() for line in done.stderr.splitlines() if line.strip()]
    why = "; ".join(dict.fromkeys(said)) or f"exit code {done.returncode}"
    if _AWAY.search(why):
        raise Unreachable(f"slurmctld does not answer ({why}); see `scontrol ping`")
    if _UNCONFIGURED.search(why):
        raise EngineError(
            "Slurm is installed but has no configuration here: put the cluster's slurm.conf at /etc/slurm/slurm.conf, or set "
            "SLURM_CONF to its path"
        )
    raise EngineError(why)


def environment() -> dict[str, str]:
    """The controller's own, which sbatch hands on to jobs: without its private variables, and without what would speak for a job.

    ``SBATCH_*`` and ``SLURM_*`` of a shell, or of an allocation in which the controller itself runs, would override the script.
    """
    commands = ("SBATCH_", "SLURM_", "SQUEUE_", "SCANCEL_")
    return inherited(["CUDA_VISIBLE_DEVICES"], commands, kept=("SLURM_CONF", "SLURM_JWT"))


def list_jobs() -> dict[str, SlurmJob]:
    """Jobs of this user that Slurm remembers, ended ones too, by number. Raises EngineError."""
    me = pwd.getpwuid(os.geteuid()).pw_name
    found = {}
    for line in call("squeue", "--noheader", "--states=all", "--user", me, "--format=%A|%T|%r|%N|%k").splitlines():
        fields = line.split("|", 4)
        if len(fields) == 5:  # a comment of somebody's may have lines
            found[fields[0]] = SlurmJob(*fields)
    return found


class Jobs:
    """A snapshot of this user's jobs, refreshed in the background: a Slurm that does not answer delays no caller for long."""

    def __init__(self) -> None:
        self._trouble: str | None = None
        """Why there is no newer picture."""
        self._jobs: Mapping[str, SlurmJob] = {}
        self._taken = 0.0
        self._late = False
        """A caller has timed out on a refresh: later ones take the snapshot as it is."""
        self._lock, self._looked = threading.Lock(), threading.Event()
        self._looked.set()

    def get(self, number: str, since: float, age: float) -> SlurmJob | None:
        """The job; None if Slurm no longer knows it. Raises Unreachable if that can't be determined.

        Args:
            number: The job's.
            since: When it was submitted (monotonic [s]): an older picture does not have it.
            age: Seconds for which a picture holds.
        """
        if time.monotonic() - self._taken > age:
            self._look()
            if not self._looked.wait(0.0 if self._late else 2.0):
                self._late = True
        if number not in self._jobs and self._taken <= since:
            raise Unreachable(self._trouble or "slurmctld has not answered yet")
        return self._jobs.get(number)

    def fresh(self) -> Mapping[str, SlurmJob]:
        """A picture taken now. Raises EngineError."""
        started = time.monotonic()
        try:
            jobs = list_jobs()
        except EngineError as error:
            self._trouble = str(error)
            raise
        with self._lock:
            if started > self._taken:
                self._jobs, self._taken, self._trouble = jobs, started, None
        return jobs

    def away(self) -> str | None:
        """Why slurmctld can't be asked, where it could not the last time; looks again in the background."""
        if self._trouble:
            self._look()
        return self._trouble

    @property
    def trouble(self) -> str | None:
        """Why the picture is an old one."""
        return self._trouble or ("slurmctld has not answered yet; see `scontrol ping`" if self._late else None)

    def _look(self) -> None:
        with self._lock:
            if not self._looked.is_set():
                return
            self._looked.clear()
        threading.Thread(target=self._take, name="squeue", daemon=True).start()

    def _take(self) -> None:
        try:
            self.fresh()
        except EngineError:
            pass  # noted
        finally:
            self._late = False
            self._looked.set()


class Hosts:
    """The cluster's nodes, looked at in the background once they are known."""

    def __init__(self) -> None:
        self._hosts = list_hosts()
        self._taken = time.monotonic()
        self._lock = threading.Lock()

    def get(self) -> Sequence[Host]:
        if time.monotonic() - self._taken > _HOSTS_AGE and self._lock.acquire(blocking=False):
            self._taken = time.monotonic()
            threading.Thread(target=self._take, name="scontrol", daemon=True).start()
        return self._hosts

    def _take(self) -> None:
        try:
            self._hosts = list_hosts()
        except EngineError:
            pass  # the last picture stands
        finally:
            self._lock.release()


def list_hosts() -> list[Host]:
    """The nodes with all that they have; those on which nothing can start now are away. Raises EngineError."""
    hosts = []
    for line in call("scontrol", "--oneliner", "show", "nodes").splitlines():
        fields = dict(re.findall(r"(\w+)=(\S*)", line))
        state = _words(fields.get("State", ""))
        if "NodeName" not in fields or "FUTURE" in state:
            continue
        gpus = sum(int(count) for count in re.findall(r"(?:^|,)gpu:(?:[^:,()]+:)?(\d+)", fields.get("Gres", "")))
        cpus = float(fields.get("CPUEfctv") or fields.get("CPUTot", "1"))
        ids = tuple(str(number) for number in range(gpus))
        memory, away = int(fields.get("RealMemory", "0")), bool(state & _AWAY_STATES)
        hosts.append(Host(f"slurm/{fields['NodeName']}", cpus, ids, memory, single=True, away=away))
    return hosts


def _words(state: str) -> set[str]:
    """``DOWN*+CLOUD`` in words. A node that is off, or booting, does not respond and is none the worse for that."""
    words = {word.rstrip("*~#!%$@^-") for word in state.split("+")}
    powers = any(word.startswith(("POWERED_", "POWERING_")) for word in words)
    return words - {"NOT_RESPONDING"} if powers else words


def address_of_this_machine() -> str | None:
    """Its address towards slurmctld, or, where that runs here, towards the first node; None for loopback. Raises EngineError."""
    told = dict(re.findall(r"^(\S+)\s+= (.*?)\s*$", call("scontrol", "show", "config"), re.MULTILINE))
    host, _, address = told.get("SlurmctldHost[0]", "").rstrip(")").partition("(")
    node = re.search(r"NodeAddr=(\S+)", call("scontrol", "--oneliner", "show", "nodes"))
    for peer in filter(None, (address or host, node and node[1])):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect((peer, 9))  # sends nothing: it only asks the kernel for the route
            except OSError:
                continue
            found = str(probe.getsockname()[0])
        if not ipaddress.ip_address(found).is_loopback:
            return found
    return None
