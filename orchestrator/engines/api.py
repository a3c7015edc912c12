"""The API of engines: the protocol by which Muster uses the systems that start processes on machines."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from orchestrator.domain.hosts import Capacity, Placement
from shared_store.contract.error_text import nearest
from shared_store.contract.node import LOG_LIMIT, NodeContract


class EngineError(Exception):
    """The engine can't do it; the message is the job's reason."""


class CannotStart(EngineError):
    """The engine tried to start a node and failed, so the attempt has failed; another one may start. AWS: CannotStartContainerError and the like."""


class NotYet(EngineError):
    """A launch has to wait, for the reason in the message. It will be tried again."""

    def __init__(self, message: str, *, unknown: bool = False) -> None:
        """``unknown``: something of the gang may run already, which can't be seen just now."""
        super().__init__(message)
        self.unknown = unknown


class Transient(NotYet):
    """The operating system or a volume failed in a way that may pass: no descriptors, processes or space, an unreachable volume."""


class EngineFault(Transient):
    """An engine raised an unexpected exception: a bug, whose traceback belongs in the log."""


@dataclass(frozen=True)
class GangNode:
    """One node of a gang, as its job describes it."""

    command: Sequence[str]
    environment: Mapping[str, str]
    """The job's own."""
    placement: Placement
    ranks: int = 1
    """Training processes."""
    container: Mapping[str, Any] = field(default_factory=dict)
    """``containerProperties``, for what an engine makes of volumes, limits and the like."""
    note: str = ""
    """A line for the beginning of its log; empty for none."""


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
    compute_environment: str
    """Name of the compute environment."""
    main: int
    nodes: Sequence[GangNode]
    grace: float
    """Seconds between SIGTERM and SIGKILL."""
    directory: str | None
    """Working directory of the commands."""
    stall_timeout: float | None = None
    """Seconds without an iteration after which a rank counts as stuck."""
    log_limit: int = LOG_LIMIT
    """Bytes of each node's log that are kept."""
    is_native: bool = False
    """It came from a job YAML, so that each of its nodes has Muster."""
    is_gang: bool = True
    """False for a single-node job, whose environment has no node variables on AWS."""
    array: tuple[int, int] | None = None
    """Index and size, of an array's child."""
    isolated: bool = False
    """Its nodes start as containers would, also where they are plain processes: it came through the Batch API."""
    bus: str | None = None
    bus_token: str | None = None
    """Address of the controller's bus router, and the attempt's credential for it."""
    title: str = ""
    """The job's name."""
    timeout: int | None = None
    """Of the attempt [s]."""
    priority: int = 0
    """The job's, inside its queue."""
    options: Mapping[str, str] = field(default_factory=dict)
    """Tags ``muster:<option>`` of its compute environment, and over them those of its queue: options for engines that have queues of their
    own."""

    @property
    def name(self) -> str:
        return f"{self.job}/{self.attempt}/{self.epoch}"

    @property
    def placements(self) -> list[Placement]:
        return [node.placement for node in self.nodes]


@dataclass(frozen=True)
class NodePlan:
    """One node as it will be started."""

    contract: NodeContract
    command: Sequence[str]
    environment: Mapping[str, str]
    placement: Placement


Request = TypeVar("Request")


@dataclass(frozen=True)
class Plan(Generic[Request]):
    """A launch before it is carried out; printable."""

    gang: Gang
    nodes: Sequence[NodePlan]
    request: Request
    """The request of the launch, in the engine's own type: processes with their environments, containers, a script, a request to AWS. A launch
    adds only what can't be known before: a free port or network, the contents of an image."""
    document: str = ""
    """The request as another scheduler will be given it, to be read: an sbatch script, a request in JSON; without credentials."""


def node_plans(gang: Gang, addresses: Sequence[str], port: int) -> list[NodePlan]:
    """The plan of each node of ``gang``, where node ``i`` has ``addresses[i]`` and all meet at the main node's ``port``."""
    shared = {each.name: getattr(gang, each.name) for each in fields(NodeContract) if hasattr(gang, each.name)}
    shared |= {"node_count": len(gang.nodes), "main_index": gang.main}
    shared |= {"master_address": addresses[gang.main], "master_port": port}
    plans = []
    for index, node in enumerate(gang.nodes):
        contract = NodeContract(
            **shared,
            node_index=index,
            ranks_per_node=node.ranks,
            isolation=_isolation(gang, node),
            cpus=node.placement.cpus,
            address=addresses[index],
            note=node.note,
        )
        plans.append(NodePlan(contract, node.command, node.environment, node.placement))
    return plans


def unused_user(user: str, why: str) -> str:
    """The note in the log of a node without an image, on which ``user`` of the definition is not taken on."""
    return f"muster: user {user} is not used: nodes run without the image, and {why}"


def _isolation(gang: Gang, node: GangNode) -> str:
    if not gang.isolated:
        return ""
    return "muster" if node.container.get("image") in (None, "", "muster") else "image"


@dataclass(frozen=True)
class Handle:
    """Identifies a launched gang, also for a controller that did not launch it."""

    engine: str
    """Name of its engine."""
    gang: str
    """Its name, ``<job>/<attempt>/<epoch>``."""
    nodes: int
    """Number of its nodes."""
    facts: Mapping[str, Any] = field(hash=False)
    """Further facts by which the engine finds it: JSON, never changed."""

    def text(self) -> str:
        """As the database keeps it."""
        return json.dumps({"engine": self.engine, "gang": self.gang, "nodes": self.nodes, "facts": self.facts})


def read_handle(text: str) -> Handle:
    """The handle that the database keeps as ``text``, also one of Muster 0.1. Raises ValueError for anything else."""
    try:
        if text.startswith("{"):
            document = json.loads(text)
            return Handle(
                str(document["engine"]), str(document["gang"]), int(document["nodes"]), dict(document["facts"])
            )
        engine, nodes, rest = text.split(" ", 2)  # of 0.1: the third is JSON of the engine's own
        facts = json.loads(rest)
        return Handle(engine, str(facts.pop("gang" if "gang" in facts else "ray")), int(nodes), facts)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"the handle of a gang is damaged ({error}): {text[:200]!r}") from error


class NodePhase(StrEnum):
    """The progress of a node. Until it has ended it counts as running: what it holds is held."""

    QUEUED = "queued"
    """The engine has the gang and waits for room."""
    STARTING = "starting"
    """It has a place, and does not run the command yet."""
    RUNNING = "running"
    UNREACHABLE = "unreachable"
    """The engine can't tell now."""
    ENDED = "ended"
    """No process of it is left, as far as the engine knows."""


class Cause(StrEnum):
    """The cause of a node's end, as its engine observed it."""

    EXIT = "exit"
    """It left by itself, with its exit code."""
    SIGNAL = "signal"
    """A signal ended its supervisor."""
    OUT_OF_MEMORY = "out of memory"
    HOST_LOST = "host lost"
    """It vanished and its end was not observed: presumably its host is lost."""
    PREEMPTED = "preempted"
    """The engine took its place away for other work."""
    STOPPED = "stopped"
    """It was stopped, in the engine or through it."""
    CANCELLED = "cancelled"
    """The same, by others than Muster, in the queue of the engine's own scheduler; ``words`` say how: ``cancelled in …, not by Muster``."""
    CANNOT_START = "cannot start"
    """It never ran: its container could not be started."""


@dataclass(frozen=True)
class NodeStatus:
    """The engine's knowledge of one node. Raises ValueError where the fields contradict each other."""

    phase: NodePhase
    address: str = ""
    words: str = ""
    """For people; nothing is decided by them. Why it does not run yet or can't be seen (then they are never empty); of one that has
    ended, what its supervisor printed where it could not write to the store, or what the engine says of its end."""
    cause: Cause | None = None
    """The cause of its end; None while it runs, or if the engine can't say."""
    exit_code: int | None = None
    """128 + n for signal n; None while it runs, or if the end was not observed."""
    gpus: tuple[str, ...] = ()
    """Ids of those that it has, from an engine that hands them out itself and tells."""
    host: str = ""
    """Name of the host that it is on, from an engine that places gangs by itself, once it tells."""
    stale: str = ""
    """Why this is an older status, from an engine that keeps the last one while its scheduler does not answer."""

    def __post_init__(self) -> None:
        if self.phase in _EXPLAINED and not self.words:
            raise ValueError(f"a node that is {self.phase} says why")
        if self.phase is not NodePhase.ENDED and (self.cause is not None or self.exit_code is not None):
            raise ValueError(f"a node that is {self.phase} has no cause and no exit code")

    @property
    def running(self) -> bool:
        """Whether it counts as running: it has not been seen to end."""
        return self.phase is not NodePhase.ENDED


_EXPLAINED = (NodePhase.QUEUED, NodePhase.STARTING, NodePhase.UNREACHABLE)


GangStatus = Sequence[NodeStatus]

StatusOrError = GangStatus | BaseException
"""A gang's status, or the error in its place where the engine can't observe that gang now."""
Look = StatusOrError
"""Its earlier name, which engines outside Muster import."""


@dataclass(frozen=True)
class Option:
    """An option of an engine, set by the tag ``muster:<name>`` of a compute environment or a queue."""

    name: str
    help: str
    """Its meaning, in a few words."""
    kind: type[str] | type[int] = str
    values: Sequence[str] = ()
    """Those that it may have; empty for any of its kind."""

    def check(self, value: str) -> None:
        """Raises ValueError, in one line, where it can't have this value."""
        if not value.strip():
            raise ValueError(f"tag muster:{self.name} is empty; it is {self.help}")
        if self.values and value not in self.values:
            raise ValueError(f"tag muster:{self.name} is {value!r}; {nearest(value, self.values)}")
        if self.kind is int and not (value.removeprefix("-").isascii() and value.removeprefix("-").isdigit()):
            raise ValueError(f"tag muster:{self.name} is {value!r}, not an integer; it is {self.help}")


@dataclass(frozen=True)
class Setting:
    """Arguments of an engine's factory."""

    home: Path
    """``$MUSTER_HOME``."""
    cpus: float | None = None
    """CPU cores of this machine to hand out, where the engine runs nodes on it; all by default."""
    gpus: Sequence[str] | None = None
    """Ids of its GPUs to hand out; all by default."""
    squeue_interval: float | None = None
    """Seconds between two calls of ``squeue``; by default the engine's own, which depends on the number of gangs."""


class SecretValues(StrEnum):
    """The way of the values of a job's secrets to its nodes."""

    NONE = "none"
    """None is safe: a job with secrets is refused."""
    ENVIRONMENT = "environment"
    """The controller puts them into the nodes' environments when it launches the gang."""
    REFERENCES = "references"
    """The engine is sent the references, and its own service has the values."""


@dataclass(frozen=True)
class Traits:
    """The properties in which engines differ, for decisions outside of them: nothing is decided by an engine's name."""

    elastic: bool = False
    """Its hosts come and go: a gang that needs more of them than there are waits, and is not refused."""
    images: bool = False
    """Nodes are containers of the job's image; else commands run in the nodes' own environment."""
    users: bool = False
    """A node can run as the user that the job names; else that is passed over with a note. True of every engine with images."""
    as_owner: bool = False
    """Nodes run as the owner of the store's directory, whoever the controller is."""
    secrets: SecretValues = SecretValues.NONE
    launches: int = 1
    """Gangs that it can start at once. Of more than one, :meth:`Engine.launch` is called on so many threads."""
    gpu_ids: bool = False
    """The ids of its hosts' GPUs are those of the devices; else they are numbers until a node's status has its ``gpus``."""
    squeue: bool = False
    """It calls ``squeue``, so that :attr:`Setting.squeue_interval` means something."""


@dataclass(frozen=True)
class EngineType:
    """The object behind an entry point of the group ``muster.engines``: a factory of the engine, and what is known without one."""

    make: Callable[[Setting], Engine]
    """Imports what the engine needs only when it is called. Raises EngineError, in one line with what to do: it is not installed, or it
    does not answer."""
    options: Sequence[Option] = ()
    traits: Traits = Traits()
    """Those of its engine."""


class Engine(Protocol):
    """Starts gangs, tells how they are, ends them. Every method may be called again after a controller restart.

    Threads: the controller gives each engine a thread of its own (:mod:`orchestrator.engines.runner`). :meth:`capacity`, :meth:`observe`
    and, unless :attr:`Traits.launches` says otherwise, :meth:`launch` are called on that thread alone, one at a time, so a call that
    takes long delays this engine's gangs only. No gang is launched by two threads at a time.
    :meth:`stop` is called on another thread for each gang, at the same time as everything else, other stops included. :meth:`plan` is
    called on any thread. What these share with the engine's thread must be guarded by a lock, or replaced as a whole and never
    changed in place.

    Errors: EngineError is final for a launch, NotYet and Transient are tried again. An OSError from the operating system or the
    store may escape: the runner decides by its number which of the two it is. It must never be taken for the end of a process.
    """

    name: str
    traits: Traits
    address: str | None
    """Address of this machine as its nodes see it, where the bus has to listen; None for loopback."""

    def capacity(self) -> Capacity:
        """``Hosts`` to place gangs on, or ``Queued`` of an engine that queues and places them by itself: always the same of the two.

        Names of hosts begin with the engine's and a slash. Until the first answer the engine's jobs wait, and its controller goes
        on without it. Raises EngineError where it isn't known now: the last answer counts, and the engine's health says why.
        """
        ...

    def plan(self, gang: Gang) -> Plan[Any]:
        """The plan of a launch. Pure, and quick. Raises EngineError where the engine can't do what the gang asks for."""
        ...

    def launch(self, plan: Plan[Any]) -> Handle:
        """Send the plan's request: start the gang, the main node first; returns its handle.

        Idempotent by (job, attempt, epoch): nodes that run already are found, not started twice. A launch that raises has ended
        what it had started, unless it raises NotYet with ``unknown``.

        Raises:
            NotYet: It has to wait, or failed in a way that may pass.
            EngineError: It is refused for good.
        """
        ...

    def observe(self, handles: Sequence[Handle]) -> Sequence[StatusOrError]:
        """The nodes, by index, of each of these gangs, in the order of ``handles``; in few requests, however many gangs there are.

        A gang that can't be looked at has its error in its place and hides no other one; an error that is raised is all gangs'. An
        engine that looks at one gang at a time uses :func:`orchestrator.engines.toolkit.statuses.one_by_one`.
        """
        ...

    def stop(self, handle: Handle, grace: float) -> None:
        """SIGTERM, ``grace`` seconds later SIGKILL; returns when no process of the gang is left.

        Raises EngineError, which is the job's reason until the next try. It never waits for an answer without end: see
        :func:`orchestrator.engines.toolkit.waiting.stop_within`.
        """
        ...

    def close(self) -> None:
        """Release what the engine holds in this process; gangs go on. Called once, also where the engine was never used."""
        ...
