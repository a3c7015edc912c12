"""A node of a gang on Slurm: what is known only where Slurm has placed it, then the supervisor's shim in this process's place.

``python -m worker.slurm_node meet``, in the batch script, on the first node: prints the nodes' addresses in the order of the tasks
and a port, as JSON. ``python -m worker.slurm_node node MEETING``, as a task: reads what the controller says from standard input. The
first task is the main node, the others follow in the order of their index. Imports no torch.
"""

from __future__ import annotations

import ipaddress
import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from shared_store.contract.node import NodeContract, sealed
from shared_store.process.ports import free_port
from shared_store.process.shim import shimmed
from worker.node.surroundings import address_towards


def meet() -> str:
    """The address at which the nodes of this job meet. Raises OSError where an address or a port can't be found."""
    names = _lines("scontrol", "show", "hostnames", os.environ["SLURM_JOB_NODELIST"])
    facts = "\n".join(_lines("scontrol", "--oneliner", "show", "node", os.environ["SLURM_JOB_NODELIST"]))
    by_name = {m[1]: m[2] for m in re.finditer(r"^NodeName=(\S+) .*?NodeAddr=(\S+)", facts, re.MULTILINE)}
    addresses = [socket.gethostbyname(by_name.get(name, name)) for name in names]
    # Debian's /etc/hosts gives a host a loopback address of its own, which the others can't use
    far = next((a for a in addresses if not ipaddress.ip_address(a).is_loopback), None)
    if far is not None and ipaddress.ip_address(addresses[0]).is_loopback:
        addresses[0] = address_towards(far)
    return json.dumps({"nodes": names, "addresses": addresses, "port": free_port(int(os.environ["SLURM_JOB_ID"]))})


def _lines(*command: str) -> list[str]:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise OSError(f"{' '.join(command)}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout.splitlines()


def contract_of(job: Mapping[str, Any], meeting: Mapping[str, Any], task: int) -> NodeContract:
    """The contract of the node that is task ``task``: 0 is the main node; the others follow in the order of their index."""
    general = dict(job["contract"])
    main = general["main_index"]
    index = main if task == 0 else task - 1 if task <= main else task
    kind = job["kinds"][job["kind"][index]]
    return NodeContract(
        **{
            **general,
            "array": tuple(general["array"]) if general["array"] else None,
            "node_index": index,
            "master_address": meeting["addresses"][0],
            "master_port": meeting["port"],
            "address": meeting["addresses"][task],
            "ranks_per_node": kind["ranks_per_node"],
            "isolation": kind["isolation"],
        }
    )


def environment_of(job: Mapping[str, Any], contract: NodeContract, inherited: Mapping[str, str]) -> dict[str, str]:
    """Slurm's environment, overridden by the job's, overridden by the contract; without the token with which the controller called
    ``sbatch``."""
    inherited = {name: value for name, value in inherited.items() if name != "SLURM_JWT"}
    return {
        "CUDA_VISIBLE_DEVICES": "",  # Slurm sets it where it gave GPUs, and does not hide them where it gave none
        **inherited,
        "PATH": f"{Path(sys.executable).parent}:{inherited.get('PATH', '/usr/bin:/bin')}",
        **sealed(job["kinds"][job["kind"][contract.node_index]]["environment"], contract.to_env()),
    }


def start(meeting: Mapping[str, Any]) -> NoReturn:
    """Become the shim of the node's supervisor. Raises OSError, ValueError: one line each.

    Without a control group of Muster's: Slurm looks for a step's processes in its own.
    """
    job = json.load(sys.stdin)
    contract = contract_of(job, meeting, int(os.environ["SLURM_PROCID"]))
    environment = environment_of(job, contract, os.environ)
    command = job["kinds"][job["kind"][contract.node_index]]["command"]
    if job["directory"]:
        os.chdir(job["directory"])
    devnull = os.open(os.devnull, os.O_RDONLY)
    os.dup2(devnull, 0)
    # where Slurm's process on this host dies, the shim ends the node
    shim = shimmed([sys.executable, "-P", "-m", "worker.supervisor", "--", *command], tied_to=os.getppid())
    os.execve(shim[0], shim, environment)


def main(argv: list[str]) -> int:
    """Entry point; 2 and one line on standard error where the node can't be started."""
    try:
        if argv == ["meet"]:
            meeting = meet()
            print(meeting)
            print(
                f"muster: meeting {meeting}", file=sys.stderr, flush=True
            )  # the controller reads it in the job's output
            return 0
        if len(argv) == 2 and argv[0] == "node":
            start(json.loads(argv[1]))
        print("usage: python -m worker.slurm_node meet | node MEETING", file=sys.stderr)
    except (OSError, ValueError) as error:
        where = os.environ.get("SLURMD_NODENAME", socket.gethostname())
        print(f"muster: node {where}: {error}", file=sys.stderr, flush=True)
    return 2
