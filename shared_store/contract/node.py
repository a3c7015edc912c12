"""The node contract: the environment variables with which every engine starts every node.

The ``AWS_BATCH_*`` names have their meaning on AWS; ``MASTER_ADDR`` and its kin are torch.distributed's; ``MUSTER_*`` are ours.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

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


def _of(variable: str) -> dict[str, str]:
    """The metadata of a field that stands in a variable as it is."""
    return {"variable": variable}


@dataclass(frozen=True)
class NodeContract:
    """The settings with which a node of a gang starts."""

    job: str = field(metadata=_of("MUSTER_JOB_ID"))
    """Job id, without ``#``."""
    attempt: int = field(metadata=_of("AWS_BATCH_JOB_ATTEMPT"))
    """From 1; grows with every launch of the job."""
    node_index: int
    node_count: int
    main_index: int
    """AWS's node indices; ``node_index == main_index`` on the main node."""
    master_address: str = field(metadata=_of("MASTER_ADDR"))
    master_port: int = field(metadata=_of("MASTER_PORT"))
    run: str = field(metadata=_of("MUSTER_RUN"))
    store: str = field(metadata=_of("MUSTER_STORE"))
    epoch: int = field(metadata=_of("MUSTER_EPOCH"))
    """Fencing number of this attempt in the run."""
    job_epoch: int = field(metadata=_of("MUSTER_JOB_EPOCH"))
    """Epoch of the job's first attempt."""
    ranks_per_node: int = field(default=1, metadata=_of("MUSTER_RANKS_PER_NODE"))
    grace: float = field(default=30.0, metadata=_of("MUSTER_GRACE_SECONDS"))
    """Seconds between SIGTERM and SIGKILL."""
    queue: str = field(default="default", metadata=_of("AWS_BATCH_JQ_NAME"))
    compute_environment: str = field(default="local", metadata=_of("AWS_BATCH_CE_NAME"))
    cpus: float = field(default=1.0, metadata=_of("MUSTER_CPUS"))
    """The node's share of CPUs, divided among its ranks."""
    stall_timeout: float | None = field(default=None, metadata=_of("MUSTER_STALL_TIMEOUT"))
    """Seconds without an iteration after which a rank counts as stuck; None: never."""
    log_limit: int = field(default=LOG_LIMIT, metadata=_of("MUSTER_LOG_LIMIT"))
    """Bytes of the node's log to keep."""
    is_gang: bool = True
    """False for a single-node job: AWS gives it no node variables."""
    array: tuple[int, int] | None = None
    """Index and size, of an array's child."""
    isolation: str = field(default="", metadata=_of("MUSTER_ISOLATION"))
    """``image``: a plain process starts as in a container: in an empty directory, with few of the machine's variables and a
    standard PATH. ``muster``: the same with Muster's own environment on PATH, as in Muster's own image. Empty: neither."""
    user: str | None = field(default=None, metadata=_of("MUSTER_USER"))
    """``UID:GID`` of the program, if it differs from the supervisor's."""
    memory_group: str = field(default="", metadata=_of("MUSTER_MEMORY_GROUP"))
    """Directory of the control group that limits the memory of the job's processes to ``memory_limit``; empty for no limit."""
    memory_limit: int = field(default=0, metadata=_of("MUSTER_MEMORY_LIMIT"))
    """MiB."""
    note: str = field(default="", metadata=_of("MUSTER_NOTE"))
    """A line for the beginning of the node's log; empty for none."""
    address: str | None = field(default=None, metadata=_of("MUSTER_ADDRESS"))
    """The node's own address, if the engine sets one."""
    bus: str | None = field(default=None, metadata=_of("MUSTER_BUS"))
    """Endpoint of the controller's bus router."""
    bus_token: str | None = field(default=None, metadata=_of("MUSTER_BUS_TOKEN"))
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
        """The variables, as an engine sets them on this node; one that is empty by default is left out where it is empty."""
        return {
            **self._batch_env(),
            "AWS_EXECUTION_ENV": "MUSTER",
            "NODE_RANK": str(self.node_rank),
            "NNODES": str(self.node_count),
            "MUSTER_GANG": self.gang,
            **{
                variable: f"{value:g}" if isinstance(value, float) else str(value)
                for variable, each in _VARIABLES.items()
                if (value := getattr(self, each.name)) or each.default not in (None, "", 0)
            },
        }

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

        env = {**_WHERE_ABSENT, "MUSTER_JOB_EPOCH": env.get("MUSTER_EPOCH", ""), **env}
        values = {each.name: _read(env, variable, each.type, each.default) for variable, each in _VARIABLES.items()}
        array = tuple(_read(env, f"AWS_BATCH_JOB_ARRAY_{each}", "int", 0) for each in ("INDEX", "SIZE"))
        return cls(
            **values,
            node_index=_read(env, "AWS_BATCH_JOB_NODE_INDEX", "int", 0),
            node_count=_read(env, "AWS_BATCH_JOB_NUM_NODES", "int", 1),
            main_index=_read(env, "AWS_BATCH_JOB_MAIN_NODE_INDEX", "int", 0),
            is_gang="AWS_BATCH_JOB_NODE_INDEX" in env,
            array=array if "AWS_BATCH_JOB_ARRAY_INDEX" in env else None,
        )


_VARIABLES = {each.metadata["variable"]: each for each in fields(NodeContract) if each.metadata}
_WHERE_ABSENT = {"AWS_BATCH_JOB_ATTEMPT": "1", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}
"""Values of variables that a node outside of a gang need not have."""
_FORMS = {
    "int": (re.compile(r"-?[0-9]+"), int, "an integer"),
    "float": (re.compile(r"[0-9]+(\.[0-9]*)?(e[+-]?[0-9]+)?"), float, "a number"),
}


def _read(env: Mapping[str, str], variable: str, kind: Any, default: Any) -> Any:
    """The value of a variable as a field of type ``kind``. Raises ContractError."""
    value = env.get(variable)
    if default is not MISSING and (value is None or (not value and kind == "float | None")):
        return default
    form, convert, words = _FORMS.get(kind.partition(" ")[0], (None, str, "a string"))
    if form.fullmatch(value or "") if form else value or default is not MISSING:
        return convert(value)
    problem = f"is {value!r}, not {words}" if value or kind == "float" else "is missing"
    raise ContractError(f"{variable} {problem}; a node is started by one of Muster's engines")
