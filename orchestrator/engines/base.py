"""The engine protocol: what Muster asks of whatever starts processes on machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from shared_store.contract import NodeContract
from shared_store.log_files import LIMIT

PRIVATE = (
    *("MUSTER_TOKEN", "MUSTER_URL", "MUSTER_KILL_AT", "MUSTER_DATABASE", "PGPASSWORD", "PGPASSFILE"),
    *("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_SECURITY_TOKEN"),
    *("AWS_CONTAINER_AUTHORIZATION_TOKEN", "RAY_AUTH_TOKEN"),
)
"""Variables of the controller that a job does not get: what it speaks to its database and its engines with."""


class EngineError(Exception):
    """The engine can't do what was asked; the message is the reason that the job is given."""


class NotYet(EngineError):
    """A launch has to wait; the message says for what. It will be asked for again."""

    def __init__(self, message: str, *, unknown: bool = False) -> None:
        """``unknown``: something of the gang may run already, which can't be seen just now."""
        super().__init__(message)
        self.unknown = unknown


class Transient(NotYet):
    """The operating system or a volume failed in a way that may pass: no descriptors, processes or space, a volume that is away."""


class EngineFault(Transient):
    """An engine raised what it should not raise: a bug, whose traceback belongs in the log."""


@dataclass(frozen=True)
class Host:
    """A machine (or what is free of it)."""

    name: str
    cpus: float
    gpus: tuple[str, ...]
    """Ids, as ``CUDA_VISIBLE_DEVICES`` takes them."""
    memory: int
    """MiB."""
    single: bool = False
    """Takes one node of a gang at most."""
    away: bool = False
    """Takes no node now, and may again: an engine that queues is given a gang that needs it, and waits for it."""
    machine: str = ""
    """Hosts of several engines that are one machine have the same, and what one of them gives away the others lack; empty: it
    has a machine of its own."""

    def left(self, cpus: float, gpus: tuple[str, ...], memory: int) -> Host:
        """The same host with that much of it."""
        return replace(self, cpus=cpus, gpus=gpus, memory=memory)


HERE = "localhost"
"""The machine of hosts that are the controller's own."""


def engine_of(host: str) -> str:
    """Name of the engine that a host belongs to: hosts are called ``<engine>/<name>``, that of the local one ``localhost``."""
    return host.partition("/")[0] if "/" in host else "local"


@dataclass(frozen=True)
class Placement:
    """Where one node goes and what it takes there."""

    host: str
    gpus: tuple[str, ...]
    cpus: float
    memory: int
    """MiB."""


@dataclass(frozen=True)
class Gang:
    """All nodes of one attempt, as the controller hands them to an engine."""

    job: str
    attempt: int
    epoch: int
    job_epoch: int
    run: str
    store: str
    queue: str
    pool: str
    """Name of the compute environment."""
    main: int
    commands: Sequence[Sequence[str]]
    environments: Sequence[Mapping[str, str]]
    placements: Sequence[Placement]
    """Commands, user environments and placements by node index."""
    grace: float
    """Seconds between SIGTERM and SIGKILL."""
    directory: str | None
    """Working directory of the commands."""
    stall_timeout: float | None = None
    """Seconds without an iteration after which a rank counts as stuck."""
    log_limit: int = LIMIT
    """Bytes of each node's log that are kept."""
    is_gang: bool = True
    """False for a single-node job, whose environment has no node variables on AWS."""
    array: tuple[int, int] | None = None
    """Index and size, of an array's child."""
    isolated: bool = False
    """Its nodes start as containers would, also where they are plain processes: it came through the Batch API."""
    containers: Sequence[Mapping[str, Any]] = ()
    """``containerProperties`` by node index, for what an engine makes of volumes, limits and the like."""
    bus: str | None = None
    bus_token: str | None = None
    """Where the controller's bus router listens, and the attempt's credential for it."""
    title: str = ""
    """What the user calls the job."""
    timeout: int | None = None
    """Of the attempt [s]."""
    priority: int = 0
    """The job's, inside its queue."""
    options: Mapping[str, str] = field(default_factory=dict)
    """Tags ``muster:<option>`` of its compute environment, and over them those of its queue: what engines that have queues
    of their own are told."""

    @property
    def name(self) -> str:
        return f"{self.job}/{self.attempt}/{self.epoch}"


@dataclass(frozen=True)
class NodePlan:
    """One node as it will be started."""

    contract: NodeContract
    command: Sequence[str]
    environment: Mapping[str, str]
    placement: Placement


@dataclass(frozen=True)
class Plan:
    """What a launch will do; printable."""

    gang: Gang
    nodes: Sequence[NodePlan]
    document: str = ""
    """What another scheduler will be given: an sbatch script, a request in JSON."""


def node_plans(gang: Gang, addresses: Sequence[str], port: int) -> list[NodePlan]:
    """What each node of ``gang`` is told, where node ``i`` has ``addresses[i]`` and the main node's ``port`` is where they meet."""
    plans = []
    for index, placement in enumerate(gang.placements):
        contract = NodeContract(
            job=gang.job,
            attempt=gang.attempt,
            node_index=index,
            node_count=len(gang.placements),
            main_index=gang.main,
            master_address=addresses[gang.main],
            master_port=port,
            run=gang.run,
            store=gang.store,
            epoch=gang.epoch,
            job_epoch=gang.job_epoch,
            ranks_per_node=int(gang.environments[index].get("MUSTER_RANKS_PER_NODE", 1)),
            grace=gang.grace,
            queue=gang.queue,
            compute_environment=gang.pool,
            is_gang=gang.is_gang,
            array=gang.array,
            isolation=_isolation(gang, index),
            cpus=placement.cpus,
            stall_timeout=gang.stall_timeout,
            log_limit=gang.log_limit,
            address=addresses[index],
            bus=gang.bus,
            bus_token=gang.bus_token,
        )
        plans.append(NodePlan(contract, gang.commands[index], gang.environments[index], placement))
    return plans


def _isolation(gang: Gang, index: int) -> str:
    if not gang.isolated:
        return ""
    image = gang.containers[index].get("image") if gang.containers else None
    return "muster" if image in (None, "", "muster") else "image"


@dataclass(frozen=True)
class NodeStatus:
    """What the engine knows of one node."""

    running: bool
    address: str
    exit_code: int | None = None
    """128 + n for signal n; None while it runs, or where nobody saw the end."""
    detail: str = ""
    """What the node's supervisor said on stderr, where it could not say it in the store; of a node that runs, why nothing can be
    told it now."""
    waiting: str = ""
    """Why the node, which counts as running, has not been started yet by an engine that queues, or can't be seen now."""
    gpus: tuple[str, ...] = ()
    """Ids of those that it has, from an engine that hands them out itself and tells."""


GangStatus = Sequence[NodeStatus]


class Engine(Protocol):
    """Starts gangs, tells how they are, ends them. Every method may be called again after a controller restart.

    Threads: the controller gives each engine a thread of its own (:mod:`orchestrator.engines.runner`). :meth:`capacity`, :meth:`launch`
    and :meth:`observe` are called on that thread alone, one at a time, so a call that takes long delays this engine's gangs only.
    :meth:`stop` is called on another thread for each gang, at the same time as everything else, other stops included. :meth:`plan` is
    called on any thread. What these share with the engine's thread must be guarded by a lock, or replaced as a whole and never
    changed in place.

    Errors: EngineError is final for a launch, NotYet and Transient are tried again. An OSError from the operating system or the
    store may escape: the runner decides by its number which of the two it is. It must never be taken for the end of a process.
    """

    name: str
    queues: bool
    """It queues gangs by itself: they are handed over at once, and what runs on its hosts is not counted here."""
    elastic: bool
    """Its hosts come and go: a gang that needs more of them than there are waits, and is not refused."""
    images: bool
    """Nodes are containers of the job's image; else commands run in the nodes' own environment."""
    address: str | None
    """Address of this machine as its nodes see it, where the bus has to listen; None for loopback."""

    def capacity(self) -> Sequence[Host]:
        """Every host with all that it has, free or not. Their names begin with the engine's and a slash."""
        ...

    def plan(self, gang: Gang) -> Plan:
        """What :meth:`launch` would do. Pure, and quick. Raises EngineError where the engine can't do what the gang asks for."""
        ...

    def launch(self, plan: Plan) -> str:
        """Start the gang, the main node first; returns its handle.

        Idempotent by (job, attempt, epoch): nodes that run already are found, not started twice. A launch that raises has ended
        what it had started, unless it raises NotYet with ``unknown``.

        Raises:
            NotYet: It has to wait, or failed in a way that may pass.
            EngineError: It is refused for good.
        """
        ...

    def observe(self, handle: str) -> GangStatus:
        """The gang's nodes by index."""
        ...

    def stop(self, handle: str, grace: float) -> None:
        """SIGTERM, ``grace`` seconds later SIGKILL; returns when no process of the gang is left. Raises EngineError."""
        ...

    def close(self) -> None:
        """Release what the engine holds in this process; gangs go on. Called once, also where the engine was never used."""
        ...
