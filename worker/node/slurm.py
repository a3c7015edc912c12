"""A node of a gang on Slurm: what is known only where Slurm has placed it, then the supervisor's shim in this process's place.

``python -m worker.slurm_node meet``, in the batch script, on the first node: prints the nodes' addresses in the order of the tasks
and a port, as JSON. ``python -m worker.slurm_node node MEETING``, as a task: reads what the controller says from standard input. The
first task is the main node, the others follow in the order of their index. Imports no torch.
"""

from __future__ import annotations

import dataclasses
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
from worker.node.network import address_towards


def meet() -> str:
    """The address at which the nodes of this job meet. Raises OSError where an address or a port can't be found."""
    names = _lines("scontrol", "show", "hostnames", os.environ["SLURM_JOB_NODELIST"])
    told = "\n".join(_lines("scontrol", "--oneliner", "show", "node", os.environ["SLURM_JOB_NODELIST"]))
    by_name = {m[1]: m[2] for m in re.finditer(r"^NodeName=(\S+) .*?NodeAddr=(\S+)", told, re.MULTILINE)}
    addresses = [socket.gethostbyname(by_name.get(name, name)) for name in names]
    # Debian's /etc/hosts gives a host a loopback address of its own, which is no use to the others
    far = next((a for a in addresses if not ipaddress.ip_address(a).is_loopback), None)
    if far is not None and ipaddress.ip_address(addresses[0]).is_loopback:
        addresses[0] = address_towards(far)
    return json.dumps({"nodes": names, "addresses": addresses, "port": free_port(int(os.environ["SLURM_JOB_ID"]))})


def _lines(*command: str) -> list[str]:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise OSError(f"{' '.join(command)}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout.splitlines()


def node_index(task: int, main: int) -> int:
    """Task 0 is the main node; the others follow in the order of their index."""
    if task == 0:
        return main
    return task - 1 if task <= main else task


def contract_of(told: Mapping[str, Any], meeting: Mapping[str, Any], task: int) -> NodeContract:
    """The contract of the node that is task ``task``."""
    general = dict(told["contract"])
    general["array"] = tuple(general["array"]) if general["array"] else None
    contract = NodeContract(**general)
    index = node_index(task, contract.main_index)
    return dataclasses.replace(
        contract,
        node_index=index,
        master_address=meeting["addresses"][0],
        master_port=meeting["port"],
        address=meeting["addresses"][task],
        ranks_per_node=told["kinds"][told["kind"][index]]["ranks_per_node"],
        isolation=told["kinds"][told["kind"][index]]["isolation"],
    )


def environment_of(told: Mapping[str, Any], contract: NodeContract, given: Mapping[str, str]) -> dict[str, str]:
    """Slurm's environment, overridden by the job's, overridden by the contract; without the token with which the controller called
    ``sbatch``."""
    given = {name: value for name, value in given.items() if name != "SLURM_JWT"}
    return {
        "CUDA_VISIBLE_DEVICES": "",  # Slurm sets it where it gave GPUs, and does not hide them where it gave none
        **given,
        "PATH": f"{Path(sys.executable).parent}:{given.get('PATH', '/usr/bin:/bin')}",
        **sealed(told["kinds"][told["kind"][contract.node_index]]["environment"], contract.to_env()),
    }


def start(meeting: Mapping[str, Any]) -> NoReturn:
    """Become the shim of the node's supervisor. Raises OSError, ValueError: one line each.

    Without a control group of Muster's: Slurm looks for a step's processes in its own.
    """
    told = json.load(sys.stdin)
    contract = contract_of(told, meeting, int(os.environ["SLURM_PROCID"]))
    environment = environment_of(told, contract, os.environ)
    command = told["kinds"][told["kind"][contract.node_index]]["command"]
    if told["directory"]:
        os.chdir(told["directory"])
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
