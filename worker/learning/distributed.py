"""Distributed training by a gang of ranks: who is there, the process group, and the few collectives that training needs.

:func:`connect` first lets every rank report to the main rank's TCP store (cheap, before anything slow) so that a rank that never
came is *named*, then opens the process group (NCCL on CUDA, Gloo elsewhere) and proves it with one all-reduce.
A gang of one rank has neither store nor group, and its collectives cost nothing.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist

from worker.settings.deferred_imports import defer_imports
from worker.settings.errors import GangError, UserError

REPORT_SECONDS = 60.0
"""Longest time between the first and the last report of a gang's ranks [s]."""
COLLECTIVE_SECONDS = 600.0
"""After how long without an answer a collective fails [s]; a peer that *died* is noticed at once, by its closed connection."""
BUILD_SECONDS = 1800.0
"""Longest time that one rank may compile kernels while others wait for its cache [s]."""


@dataclass(frozen=True)
class RankPlacement:
    """This process's place in its gang (torchrun's variables)."""

    rank: int = 0
    local_rank: int = 0
    world_size: int = 1
    local_world_size: int = 1
    master_address: str = "127.0.0.1"
    master_port: int = 29500
    epoch: int = 0
    """Fencing number of the attempt: ranks of two attempts never meet in one group."""
    has_store: bool = False
    """Whether a launcher (torchrun) keeps the TCP store already, at the master's address and port."""

    @classmethod
    def from_env(cls, env: Mapping[str, str]) -> RankPlacement:
        """Read ``RANK``, ``WORLD_SIZE`` and their kin. Raises ValueError naming one that is malformed."""

        def integer(name: str, default: int) -> int:
            value = env.get(name) or str(default)
            if not value.isdecimal():
                raise ValueError(
                    f"{name} is {value!r}, not an integer; ranks are started by worker.supervisor or by torchrun"
                )
            return int(value)

        has_store = env.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
        placement = cls(
            rank=integer("RANK", 0),
            local_rank=integer("LOCAL_RANK", 0),
            world_size=integer("WORLD_SIZE", 1),
            local_world_size=integer("LOCAL_WORLD_SIZE", 1),
            master_address=env.get("MASTER_ADDR") or "127.0.0.1",
            master_port=integer("MASTER_PORT", 29500),
            # torchrun's store outlives its ranks
            epoch=integer("MUSTER_EPOCH", integer("TORCHELASTIC_RESTART_COUNT", 0) if has_store else 0),
            has_store=has_store,
        )
        if not 0 <= placement.rank < placement.world_size:
            raise ValueError(f"RANK is {placement.rank} in a WORLD_SIZE of {placement.world_size}; ranks count from 0")
        return placement

    @property
    def device(self) -> str:
        """``cuda:<local rank>`` where there is CUDA, else ``cpu``."""
        return f"cuda:{self.local_rank}" if torch.cuda.is_available() else "cpu"

    def describe(self, rank: int) -> str:
        """``rank 5 (node 2)``; every node of a gang has the same number of ranks."""
        return f"rank {rank} (node {rank // self.local_world_size})"


class Gang:
    """The ranks of one attempt, connected. Collectives work in place and are no-ops in a gang of one."""

    def __init__(self, placement: RankPlacement, device: str, store: dist.Store | None, sites: list[str]) -> None:
        self.placement, self.device, self.store = placement, device, store
        self.rank, self.size, self.is_main = placement.rank, placement.world_size, placement.rank == 0
        self._sites = sites
        self._messages = 0

    def sum(self, tensor: torch.Tensor) -> torch.Tensor:
        """Sum ``tensor`` over the ranks, in place; all ranks end with the same bits."""
        if self.size > 1:
            dist.all_reduce(tensor)
        return tensor

    def broadcast(self, tensor: torch.Tensor) -> torch.Tensor:
        """Overwrite ``tensor`` with the main rank's."""
        if self.size > 1:
            dist.broadcast(tensor, src=0)
        return tensor

    def greatest(self, value: int) -> int:
        """The greatest ``value`` that any rank gave. Waits for all of them."""
        if self.size == 1:
            return value
        tensor = torch.tensor([value], device=self.device)
        dist.all_reduce(tensor, op=dist.ReduceOp.MAX)
        return int(tensor.item())

    def broadcast_text(self, text: str | None) -> str | None:
        """The main rank's ``text``, on every rank. Raises GangError if the main rank has ended."""
        if self.store is None:
            return text
        self._messages += 1
        key = f"message/{self._messages}"
        if self.is_main:
            self.store.set(key, "-" if text is None else f"+{text}")
            return text
        with _needs_main_rank():
            answer = self.store.get(key).decode()
        return answer[1:] if answer.startswith("+") else None

    @contextlib.contextmanager
    def in_turn(self, what: str) -> Iterator[None]:
        """A block that the first rank of each (host, kernel cache) goes through before the others, which find that cache filled.

        Args:
            what: What is done; only the first time of each is in turn.

        Raises:
            GangError: The main rank has ended, or the first rank took longer than ``BUILD_SECONDS``.
        """
        first = self._sites.index(self._sites[self.rank])
        key = f"done/{what}/{first}"
        if self.store is not None and self.rank != first:
            with _needs_main_rank():
                self.store.wait([key], timedelta(seconds=BUILD_SECONDS))
        try:
            yield
        finally:
            if self.store is not None and self.rank == first:
                with _needs_main_rank():
                    self.store.set(key, "1")

    def close(self) -> None:
        """Leave the process group."""
        if self.size > 1 and dist.is_initialized():
            dist.destroy_process_group()


@contextlib.contextmanager
def _needs_main_rank() -> Iterator[None]:
    """Raise GangError where the gang's store, which the main rank holds, fails or does not answer in time."""
    try:
        yield
    except dist.DistError as error:
        raise GangError("the main rank ended or did not answer in time; its log gives the reason") from error


def connect_rank(env: Mapping[str, str]) -> Gang:
    """:func:`connect` this rank, placed by the variables in ``env``. Raises UserError for a malformed one, and for a GPU that can't be used."""
    use_cpu_threads(env)
    try:
        placement = RankPlacement.from_env(env)
        require_gpus(env.get("CUDA_VISIBLE_DEVICES", ""), placement.local_rank)
    except ValueError as error:
        raise UserError(str(error)) from error
    return connect(placement, report_seconds=float(env.get("MUSTER_REPORT_SECONDS") or REPORT_SECONDS))


def require_gpus(visible: str, local_rank: int) -> None:
    """Check that PyTorch can use the GPU of this rank, which would train on the CPU otherwise.

    Args:
        visible: ``CUDA_VISIBLE_DEVICES``, in which engines name the GPUs of a node; empty for none.
        local_rank: The rank's number on its node, which is that of its GPU.

    Raises:
        ValueError: It can't.
    """
    if visible.strip() not in ("", "-1", "NoDevFiles") and torch.cuda.device_count() <= local_rank:
        raise ValueError(
            f"this node has GPU {visible}, and PyTorch {torch.__version__} can use {torch.cuda.device_count() or 'none'} of them; "
            "install a PyTorch with CUDA and a driver that fits it, or set resources.gpus to 0"
        )


def connect(placement: RankPlacement, *, device: str | None = None, report_seconds: float = REPORT_SECONDS) -> Gang:
    """Form the gang: report, process group, one all-reduce. Every rank calls it.

    Raises:
        GangError: Ranks did not report within ``report_seconds``, or can't reach each other.
    """
    defer_imports()
    device = device or placement.device
    if device.startswith("cuda"):
        torch.cuda.set_device(device)
        torch.cuda.set_stream(torch.cuda.Stream())  # the default stream can't be recorded
        torch.set_float32_matmul_precision("high")  # TF32 products, sums in float32, as Isaac Lab trains
    if placement.world_size == 1:
        return Gang(placement, device, None, ["here"])
    store = dist.PrefixStore(f"muster/{placement.epoch}", _open_store(placement, report_seconds))
    sites = _report(placement, store, report_seconds)
    cuda = device.startswith("cuda")
    try:
        dist.init_process_group(
            "nccl" if cuda else "gloo",
            store=dist.PrefixStore("group", store),
            rank=placement.rank,
            world_size=placement.world_size,
            timeout=timedelta(seconds=COLLECTIVE_SECONDS),
            device_id=torch.device(device) if cuda else None,
        )
        probe = torch.tensor([float(placement.rank + 1)], device=device)
        dist.all_reduce(probe)
    except RuntimeError as error:
        interface = os.environ.get("NCCL_SOCKET_IFNAME" if cuda else "GLOO_SOCKET_IFNAME", "chosen by itself")
        raise GangError(
            f"{placement.describe(placement.rank)} reached the main node but not its peers (network interface: {interface}): {error}"
        ) from error
    if round(probe.item()) != placement.world_size * (placement.world_size + 1) // 2:
        raise GangError(f"the first all-reduce gave {probe.item():g}: two ranks have the same number")
    store.set_timeout(timedelta(seconds=COLLECTIVE_SECONDS))
    return Gang(placement, device, store, sites)


def _open_store(placement: RankPlacement, seconds: float) -> dist.TCPStore:
    """The main rank's TCP store, listening on the main node's address alone; or the one that is there."""
    address, port = placement.master_address, placement.master_port
    if placement.rank == 0 and not placement.has_store:
        # without a socket of ours torch would listen on every interface
        descriptor = _listen(address, port)
        return dist.TCPStore(
            address, port, None, True, timedelta(seconds=seconds), wait_for_workers=False, master_listen_fd=descriptor
        )
    try:
        return dist.TCPStore(address, port, None, False, timedelta(seconds=seconds), wait_for_workers=False)
    except RuntimeError as error:
        raise GangError(
            f"{placement.describe(placement.rank)} could not reach rank 0 (node 0) at {address}:{port} within {seconds:g} s: "
            "is the main node up, and is the port open between the nodes?"
        ) from error


def _listen(address: str, port: int) -> int:
    listener = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        try:
            listener.bind((address, port))
        except OSError as error:
            if error.errno != errno.EADDRNOTAVAIL:
                raise
            listener.bind(("", port))  # the node has its public address by translation only
        listener.listen(2048)
    except OSError as error:
        listener.close()
        raise GangError(
            f"rank 0 can't listen on {address}:{port} ({error.strerror}); free the port or set MASTER_PORT"
        ) from error
    return listener.detach()


def _report(placement: RankPlacement, store: dist.Store, seconds: float) -> list[str]:
    """Every rank reports; returns each rank's (host, kernel cache)."""
    site = f"{socket.gethostname()}:{os.environ.get('WARP_CACHE_PATH', '')}"
    store.set(f"here/{placement.rank}", site)
    if placement.rank == 0:
        verdict = _await_reports(placement, store, seconds)
    else:
        try:
            store.wait(["verdict"], timedelta(seconds=seconds + 10))
            verdict = store.get("verdict").decode()
        except RuntimeError as error:
            raise GangError(f"rank 0 (node 0) answered no more while the gang was forming: {error}") from error
        if verdict:
            store.add("read", 1)
    if verdict:
        raise GangError(verdict)
    return [store.get(f"here/{rank}").decode() for rank in range(placement.world_size)]


def _await_reports(placement: RankPlacement, store: dist.Store, seconds: float) -> str:
    """Wait for the reports, on the main rank; returns the error if some are missing, once the others had time to read it."""
    deadline = time.monotonic() + seconds
    missing = list(range(placement.world_size))
    while missing := [rank for rank in missing if not store.check([f"here/{rank}"])]:
        if time.monotonic() > deadline:
            break
        time.sleep(0.02)
    names, present = ", ".join(map(placement.describe, missing)), placement.world_size - len(missing)
    verdict = missing and (
        f"{names} did not report within {seconds:g} s: {present} of {placement.world_size} ranks are here. "
        f"Look at the log of that node; it must reach {placement.master_address}:{placement.master_port}"
    )
    store.set("verdict", verdict or "")
    deadline = time.monotonic() + 3.0
    # the store ends with this process: give the others a moment
    while missing and store.add("read", 0) < present - 1 and time.monotonic() < deadline:
        time.sleep(0.02)
    return verdict or ""


def use_cpu_threads(env: Mapping[str, str]) -> None:
    """Give torch ``OMP_NUM_THREADS`` threads; without it, this rank's share of the host."""
    threads = env.get("OMP_NUM_THREADS", "")
    share = len(os.sched_getaffinity(0)) // max(1, int(env.get("LOCAL_WORLD_SIZE", "1")))
    torch.set_num_threads(int(threads) if threads.isdecimal() and int(threads) > 0 else max(1, share))
