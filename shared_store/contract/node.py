"""The node contract: the environment variables with which every engine starts every node.

The ``AWS_BATCH_*`` names have their meaning on AWS; ``MASTER_ADDR`` and its kin are torch.distributed's; ``MUSTER_*`` are ours.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

LOG_LIMIT = 1 << 30
"""Bytes of a node's log in one attempt to keep, by default."""
LEAST_LOG_LIMIT = 1 << 20
"""Bytes below which a limit is refused."""
BUS_VARIABLES = ("MUSTER_BUS", "MUSTER_BUS_TOKEN")
"""For the node's supervisor only: the job's own program does not get them."""
OWN_VARIABLES = (*BUS_VARIABLES, "MUSTER_MEMORY_GROUP", "MUSTER_MEMORY_LIMIT", "MUSTER_NOTE")
"""The same, with those for a node that has a supervisor in any case."""
_FOR_RANKS = "MUSTER_RANK_ENV_"
"""Prefix of the job's own variables on their way through the supervisor."""


def sealed(job: Mapping[str, str], contract: Mapping[str, str]) -> dict[str, str]:
    """The variables of a node's supervisor: the contract, and the job's own with a prefix, so that only its ranks see them.

    A job's ``PYTHONPATH``, ``LD_PRELOAD`` or ``TMPDIR`` must not change its supervisor. The contract wins over the job.
    """
    return {**{f"{_FOR_RANKS}{name}": value for name, value in job.items() if name not in contract}, **contract}


def sealed_in_image(job: Mapping[str, str], contract: Mapping[str, str]) -> dict[str, str]:
    """The same for a container: a job's ``PATH`` also stays in place, since it is searched for the image's Python."""
    return {**sealed(job, contract), **{name: value for name, value in job.items() if name == "PATH"}}


def job_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """The job's own variables among those of its supervisor."""
    return {name[len(_FOR_RANKS) :]: value for name, value in environment.items() if name.startswith(_FOR_RANKS)}


def rank_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables of a rank, from those of its supervisor: the job's own override the node's inherited ones."""
    inherited = {name: value for name, value in environment.items() if not name.startswith(_FOR_RANKS)}
    return {**inherited, **job_variables(environment)}


class ContractError(Exception):
    """A variable of the node contract is missing or malformed; the message names it."""


@dataclass(frozen=True)
class NodeContract:
    """The settings with which a node of a gang starts."""

    job: str
    """Job id, without ``#``."""
    attempt: int
    """From 1; grows with every launch of the job."""
    node_index: int
    node_count: int
    main_index: int
    """AWS's node indices; ``node_index == main_index`` on the main node."""
    master_address: str
    master_port: int
    run: str
    store: str
    epoch: int
    """Fencing number of this attempt in the run."""
    job_epoch: int
    """Epoch of the job's first attempt."""
    ranks_per_node: int = 1
    grace: float = 30.0
    """Seconds between SIGTERM and SIGKILL."""
    queue: str = "default"
    compute_environment: str = "local"
    cpus: float = 1.0
    """The node's share of CPUs, divided among its ranks."""
    stall_timeout: float | None = None
    """Seconds without an iteration after which a rank counts as stuck; None: never."""
    log_limit: int = LOG_LIMIT
    """Bytes of the node's log to keep."""
    is_gang: bool = True
    """False for a single-node job: AWS gives it no node variables."""
    array: tuple[int, int] | None = None
    """Index and size, of an array's child."""
    isolation: str = ""
    """``image``: a plain process starts as in a container: in an empty directory, with few of the machine's variables and a
    standard PATH. ``muster``: the same with Muster's own environment on PATH, as in Muster's own image. Empty: neither."""
    user: str | None = None
    """``UID:GID`` of the program, if it differs from the supervisor's."""
    memory_group: str = ""
    """Directory of the control group that limits the memory of the job's processes to ``memory_limit``; empty for no limit."""
    memory_limit: int = 0
    """MiB."""
    note: str = ""
    """A line for the beginning of the node's log; empty for none."""
    address: str | None = None
    """The node's own address, if the engine sets one."""
    bus: str | None = None
    """Endpoint of the controller's bus router."""
    bus_token: str | None = None
    """The attempt's :class:`~shared_store.contract.bus.Credential`, as text."""

    @property
    def node_rank(self) -> int:
        """Rank of the node: 0 for the main node whatever its index; the others follow in the order of their indices."""
        if self.node_index == self.main_index:
            return 0
        return self.node_index + (1 if self.node_index < self.main_index else 0)

    @property
    def world_size(self) -> int:
        return self.node_count * self.ranks_per_node

    @property
    def gang(self) -> str:
        """Name of the attempt, which every process of it carries, so that a stop misses none."""
        return f"{self.job}/{self.attempt}/{self.epoch}"

    def to_env(self) -> dict[str, str]:
        """The variables, as an engine sets them on this node."""
        env = {
            **self._batch_env(),
            "AWS_BATCH_JOB_ATTEMPT": str(self.attempt),
            "AWS_BATCH_CE_NAME": self.compute_environment,
            "AWS_BATCH_JQ_NAME": self.queue,
            "AWS_EXECUTION_ENV": "MUSTER",
            "MASTER_ADDR": self.master_address,
            "MASTER_PORT": str(self.master_port),
            "NODE_RANK": str(self.node_rank),
            "NNODES": str(self.node_count),
            "MUSTER_JOB_ID": self.job,
            "MUSTER_RUN": self.run,
            "MUSTER_STORE": self.store,
            "MUSTER_EPOCH": str(self.epoch),
            "MUSTER_JOB_EPOCH": str(self.job_epoch),
            "MUSTER_GANG": self.gang,
            "MUSTER_RANKS_PER_NODE": str(self.ranks_per_node),
            "MUSTER_GRACE_SECONDS": f"{self.grace:g}",
            "MUSTER_CPUS": f"{self.cpus:g}",
            "MUSTER_LOG_LIMIT": str(self.log_limit),
        }
        stall = None if self.stall_timeout is None else f"{self.stall_timeout:g}"
        optional = {
            "MUSTER_STALL_TIMEOUT": stall,
            "MUSTER_ISOLATION": self.isolation,
            "MUSTER_USER": self.user,
            "MUSTER_MEMORY_GROUP": self.memory_group,
            "MUSTER_MEMORY_LIMIT": str(self.memory_limit or ""),
            "MUSTER_NOTE": self.note,
            "MUSTER_ADDRESS": self.address,
            "MUSTER_BUS": self.bus,
            "MUSTER_BUS_TOKEN": self.bus_token,
        }
        return env | {name: value for name, value in optional.items() if value}

    def _batch_env(self) -> dict[str, str]:
        """The variables that depend on the kind of job; only the other nodes get the main node's address."""
        if not self.is_gang:
            env = {"AWS_BATCH_JOB_ID": self.job}
            if self.array is not None:
                env |= {"AWS_BATCH_JOB_ARRAY_INDEX": str(self.array[0]), "AWS_BATCH_JOB_ARRAY_SIZE": str(self.array[1])}
            return env
        env = {
            "AWS_BATCH_JOB_ID": f"{self.job}#{self.node_index}",
            "AWS_BATCH_JOB_NODE_INDEX": str(self.node_index),
            "AWS_BATCH_JOB_NUM_NODES": str(self.node_count),
            "AWS_BATCH_JOB_MAIN_NODE_INDEX": str(self.main_index),
        }
        if self.node_index != self.main_index:
            env["AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS"] = self.master_address
        return env

    @classmethod
    def from_env(cls, env: Mapping[str, str]) -> NodeContract:
        """Read the contract. Raises ContractError naming the variable that is missing or malformed."""

        def integer(name: str, default: int | None = None) -> int:
            value = env.get(name, "" if default is None else str(default))
            if not re.fullmatch(r"-?[0-9]+", value):
                problem = f"is {value!r}, not a whole number" if value else "is missing"
                raise ContractError(f"{name} {problem}; a node is started by one of Muster's engines")
            return int(value)

        def number(name: str, default: float) -> float:
            value = env.get(name, str(default))
            if not re.fullmatch(r"[0-9]+(\.[0-9]*)?(e[+-]?[0-9]+)?", value):
                raise ContractError(f"{name} is {value!r}, not a number; a node is started by one of Muster's engines")
            return float(value)

        def text(name: str) -> str:
            if not env.get(name):
                raise ContractError(f"{name} is missing; a node is started by one of Muster's engines")
            return env[name]

        index, main = integer("AWS_BATCH_JOB_NODE_INDEX", 0), integer("AWS_BATCH_JOB_MAIN_NODE_INDEX", 0)
        epoch = integer("MUSTER_EPOCH")
        array = (integer("AWS_BATCH_JOB_ARRAY_INDEX", 0), integer("AWS_BATCH_JOB_ARRAY_SIZE", 0))
        return cls(
            job=text("MUSTER_JOB_ID"),
            attempt=integer("AWS_BATCH_JOB_ATTEMPT", 1),
            node_index=index,
            node_count=integer("AWS_BATCH_JOB_NUM_NODES", 1),
            main_index=main,
            master_address=env.get("MASTER_ADDR", "127.0.0.1"),
            master_port=integer("MASTER_PORT", 29500),
            run=text("MUSTER_RUN"),
            store=text("MUSTER_STORE"),
            epoch=epoch,
            job_epoch=integer("MUSTER_JOB_EPOCH", epoch),
            ranks_per_node=integer("MUSTER_RANKS_PER_NODE", 1),
            grace=number("MUSTER_GRACE_SECONDS", 30.0),
            queue=env.get("AWS_BATCH_JQ_NAME", "default"),
            compute_environment=env.get("AWS_BATCH_CE_NAME", "local"),
            cpus=number("MUSTER_CPUS", 1.0),
            stall_timeout=float(env["MUSTER_STALL_TIMEOUT"]) if env.get("MUSTER_STALL_TIMEOUT") else None,
            log_limit=integer("MUSTER_LOG_LIMIT", LOG_LIMIT),
            is_gang="AWS_BATCH_JOB_NODE_INDEX" in env,
            array=array if "AWS_BATCH_JOB_ARRAY_INDEX" in env else None,
            isolation=env.get("MUSTER_ISOLATION", ""),
            user=env.get("MUSTER_USER"),
            memory_group=env.get("MUSTER_MEMORY_GROUP", ""),
            memory_limit=integer("MUSTER_MEMORY_LIMIT", 0),
            note=env.get("MUSTER_NOTE", ""),
            address=env.get("MUSTER_ADDRESS"),
            bus=env.get("MUSTER_BUS"),
            bus_token=env.get("MUSTER_BUS_TOKEN"),
        )
