"""Two hosts on this machine: network namespaces, which reach each other over TCP alone."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping

from tests.support.worker.ranks import ROOT

NAMES = ("muster-host-0", "muster-host-1")
ADDRESSES = ("10.177.0.1", "10.177.0.2")


@contextlib.contextmanager
def two_hosts() -> Iterator[None]:
    """:data:`NAMES` at :data:`ADDRESSES`, joined by one cable. Raises OSError where the kernel does not let this user make them."""
    try:
        for name in NAMES:
            _ip("netns", "add", name)
        _ip("link", "add", "eth0", "netns", NAMES[0], "type", "veth", "peer", "name", "eth0", "netns", NAMES[1])
        for name, address in zip(NAMES, ADDRESSES, strict=True):
            _ip("-n", name, "addr", "add", f"{address}/24", "dev", "eth0")
            for device in ("lo", "eth0"):
                _ip("-n", name, "link", "set", device, "up")
        yield
    finally:
        for name in NAMES:
            subprocess.run(["ip", "netns", "del", name], capture_output=True)


def start_ranks(
    arguments: list[str], gpus: int, env: Mapping[str, str], stdout: int | None = None, stderr: int | None = None
) -> list[subprocess.Popen[str]]:
    """``python ARGUMENTS`` once for each of ``gpus`` GPUs, half of them on each host, with the environment that a supervisor gives a rank.

    NCCL_HOSTID keeps NCCL from seeing that both hosts are one machine, whose memory it would use.
    """
    each = gpus // 2
    processes = []
    for rank in range(gpus):
        host, local = divmod(rank, each)
        supplied = {
            "RANK": str(rank),
            "WORLD_SIZE": str(gpus),
            "LOCAL_RANK": str(local),
            "LOCAL_WORLD_SIZE": str(each),
            "MASTER_ADDR": ADDRESSES[0],
            "MASTER_PORT": "29500",
            "OMP_NUM_THREADS": "4",
            "CUDA_VISIBLE_DEVICES": ",".join(str(host * each + gpu) for gpu in range(each)),
            "NCCL_HOSTID": NAMES[host],
            "NCCL_SOCKET_IFNAME": "eth0",
            "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
            "NCCL_IB_DISABLE": "1",
            "TORCH_NCCL_ASYNC_ERROR_HANDLING": "1",
        }
        command = ["ip", "netns", "exec", NAMES[host], sys.executable, *arguments]
        processes.append(
            subprocess.Popen(command, env={**os.environ, **supplied, **env}, text=True, stdout=stdout, stderr=stderr)
        )
    return processes


def _ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True)
    if done.returncode:
        raise OSError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")


def free_ports(count: int) -> list[int]:
    """Ports that nobody has just now, below those that the kernel hands out: no connection takes them while their server is down."""
    found: list[int] = []
    candidate = 20000 + os.getpid() * 16 % 12000
    while len(found) < count:
        candidate += 1
        with socket.socket() as probe:
            try:
                probe.bind(("", candidate))
                found.append(candidate)
            except OSError:
                continue
    return found
