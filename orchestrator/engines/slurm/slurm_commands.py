"""Slurm's own commands: calling them, and reading their answers."""

from __future__ import annotations

import ipaddress
import os
import pwd
import re
import socket
import subprocess
from dataclasses import dataclass

from orchestrator.domain.hosts import Host
from orchestrator.engines.api import EngineError, NotYet
from orchestrator.engines.toolkit.environment import inherited

_LIMIT = 30.0
"""Seconds after which a command has failed: Slurm's own patience with a controller that is away is a minute and more."""
_UNREACHABLE = re.compile(
    r"(?i)unable to contact|connection (refused|timed out)|socket timed out|not responding|zero bytes|try again"
)
_UNCONFIGURED = re.compile("Could not establish a configuration source|resolve_ctls_from_dns_srv")
_UNAVAILABLE_STATES = frozenset(
    {"DOWN", "DRAIN", "DRAINED", "DRAINING", "ERROR", "FAIL", "FAILING", "INVAL", "INVALID_REG"}
    | {"MAINT", "MAINTENANCE", "NOT_RESPONDING", "UNKNOWN"}
)
"""Words of a node's state that mean that nothing can start there now. ``POWERED_DOWN`` is none: Slurm boots such a node for a job."""


class SlurmUnreachable(NotYet):
    """slurmctld does not answer now; it may later."""


@dataclass(frozen=True)
class SlurmJob:
    """One job as ``squeue`` reports it."""

    number: str
    state: str
    reason: str
    hosts: str
    comment: str


def call(*command: str, text: str | None = None) -> str:
    """The output of one of Slurm's commands.

    Raises:
        SlurmUnreachable: slurmctld does not answer.
        EngineError: It refused, in its own words.
    """
    if (path := os.environ.get("SLURM_CONF")) and not os.path.exists(path):  # Slurm itself would try for a minute
        raise SlurmUnreachable(f"SLURM_CONF is {path}, which does not exist; set it to the cluster's slurm.conf")
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
        raise SlurmUnreachable(f"can't run {command[0]} now: {error}") from None
    except subprocess.TimeoutExpired:
        raise SlurmUnreachable(
            f"slurmctld does not answer ({command[0]} waited {_LIMIT:g} s); see `scontrol ping`"
        ) from None
    if done.returncode == 0:
        return done.stdout
    lines = [re.sub(r"^\w+: (error|fatal): ", "", line).strip() for line in done.stderr.splitlines() if line.strip()]
    why = "; ".join(dict.fromkeys(lines)) or f"exit code {done.returncode}"
    if _UNREACHABLE.search(why):
        raise SlurmUnreachable(f"slurmctld does not answer ({why}); see `scontrol ping`")
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
        if len(fields) == 5:  # a user's comment may have lines
            found[fields[0]] = SlurmJob(*fields)
    return found


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
        memory, unavailable = int(fields.get("RealMemory", "0")), bool(state & _UNAVAILABLE_STATES)
        hosts.append(Host(f"slurm/{fields['NodeName']}", cpus, ids, memory, single=True, unavailable=unavailable))
    return hosts


def _words(state: str) -> set[str]:
    """``DOWN*+CLOUD`` in words. A node that is off, or booting, does not respond and is none the worse for that."""
    words = {word.rstrip("*~#!%$@^-") for word in state.split("+")}
    powers = any(word.startswith(("POWERED_", "POWERING_")) for word in words)
    return words - {"NOT_RESPONDING"} if powers else words


def address_of_this_machine() -> str | None:
    """Its address towards slurmctld, or, where that runs here, towards the first node; None for loopback. Raises EngineError."""
    config = dict(re.findall(r"^(\S+)\s+= (.*?)\s*$", call("scontrol", "show", "config"), re.MULTILINE))
    host, _, address = config.get("SlurmctldHost[0]", "").rstrip(")").partition("(")
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
