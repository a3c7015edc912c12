"""An engine with a home and a store of its own, and the gangs that a test starts on it: what the tests of every engine share."""

from __future__ import annotations

import uuid
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from orchestrator.domain.hosts import Placement
from orchestrator.engines.api import Engine, Gang, GangNode, Handle, NodeStatus, NotYet
from orchestrator.engines.testing import rigs
from orchestrator.engines.toolkit.statuses import status_of
from shared_store.volume.epoch import raise_epoch, read_epoch
from shared_store.volume.layout import Store
from shared_store.volume.log_view import LogView
from shared_store.volume.logs import LogLine
from shared_store.volume.node_outcomes import Outcome, read_outcome
from tests.support.engines.sites import WAIT
from tests.support.processes import processes_of
from tests.support.waiting import wait_for

_OF_NODES = {"commands": "command", "environments": "environment", "placements": "placement"}
_OF_NODES |= {"containers": "container", "ranks": "ranks"}


def make_gang(store: Path, script: str = WAIT, nodes: int = 2, **changes: Any) -> Gang:
    """A gang whose nodes run ``sh -c script``, with ``changes``; :data:`_OF_NODES` are lists with an entry for each node."""
    attempt, command, environment = changes.get("attempt", 1), ["sh", "-c", script], {"GREETING": "hello"}
    lists: dict[str, Sequence[Any]] = {"command": [command] * nodes, "environment": [environment] * nodes}
    lists["placement"] = [Placement("localhost", (), 0.5, 64)] * nodes
    lists |= {name: changes.pop(plural) for plural, name in _OF_NODES.items() if plural in changes}
    gang = rigs.make_gang("job", str(store), nodes, "localhost", ["sh", "-c", script])
    facts: dict[str, Any] = {"attempt": attempt, "epoch": attempt, "run": "run", "compute_environment": "here"}
    facts |= {"grace": 5.0, "is_native": False}
    facts["nodes"] = [GangNode(**dict(zip(lists, each, strict=True))) for each in zip(*lists.values(), strict=True)]
    return replace(gang, **{**facts, **changes})


class Bench(ABC):
    """An engine, its home and its store, and the gangs that it started. A subclass says which engine, and what a gang needs there."""

    asks_again: tuple[str, ...] = ()
    """Parts of the reasons for which a launch has to wait where :meth:`start` goes on asking."""

    def __init__(self, home: Path, store: Store | None = None, job: str = "") -> None:
        """``store``: a new one by default. ``job``: the id of the gangs' job, a new one by default."""
        self.home = home
        self.store = store or Store(home / "store").open()
        self.job = job or str(uuid.uuid4())
        self.run = self.store.run("run")
        self.run.create({"run": "run"})
        if read_epoch(self.run) < 1:
            raise_epoch(self.run, 1)
        self.engine = self.new_engine()
        self.handles: list[Handle] = []

    @abstractmethod
    def new_engine(self) -> Engine:
        """A new object for the engine, such as a controller makes at its start."""

    # -- gangs --------------------------------------------------------------------------------------------------------

    def gang(self, script: str = WAIT, nodes: int = 2, *, suffix: str = "", **changes: Any) -> Gang:
        """A gang whose nodes run ``sh -c script``, with ``changes``. ``suffix``: of the job's id, for another job."""
        return make_gang(self.store.path, script, nodes, **{"job": self.job + suffix, **changes})

    def launch(self, gang: Gang, engine: Engine | None = None) -> Handle:
        """Give the run to the gang and start it, as a controller does; returns the handle."""
        run = self.store.run(gang.run)
        if read_epoch(run) < gang.epoch:
            raise_epoch(run, gang.epoch)
        return self.start(gang, engine)

    def start(self, gang: Gang, engine: Engine | None = None) -> Handle:
        """Start the gang, even where the run is another one's."""
        engine = engine or self.engine
        plan = engine.plan(gang)

        def started() -> Handle | None:
            try:
                return engine.launch(plan)
            except NotYet as reason:
                if any(text in str(reason) for text in self.asks_again):
                    return None
                raise

        handle: Handle = wait_for(started, 60, "an answer")
        if handle not in self.handles:
            self.handles.append(handle)
        return handle

    def ready(self, gang: Gang) -> Handle:
        """Launch the gang, if that was not done, and wait until every node has printed ``ready``; returns the handle."""
        handle = self.launch(gang)

        def output() -> bool:
            status_of(self.engine, handle)  # as a controller does all the time
            return self.log(gang.attempt, job=gang.job, run=gang.run).count("ready") == len(gang.nodes)

        wait_for(output, 60, f"{len(gang.nodes)} ready nodes")
        return handle

    def ended(self, handle: Handle, engine: Engine | None = None) -> list[NodeStatus]:
        """Wait until all nodes have ended; returns how."""

        def over() -> list[NodeStatus] | None:
            status = list(status_of(engine or self.engine, handle))
            return None if any(node.running for node in status) else status

        found: list[NodeStatus] = wait_for(over, 60, "the gang's end")
        return found

    def stopped(self, handle: Handle, grace: float = 5.0) -> list[int | None]:
        """Stop the only gang and check that nothing of it is left; returns the exit codes."""
        self.engine.stop(handle, grace)
        self.nothing_is_left()
        return [node.exit_code for node in status_of(self.engine, handle)]

    # -- logs, outcomes, processes ------------------------------------------------------------------------------------

    def lines(self, attempt: int = 1, *, job: str = "", run: str = "run") -> list[LogLine]:
        """All lines of an attempt's log."""
        found = LogView.of(self.store.run(run), job or self.job).drain()
        return [line for line in found if line.attempt == attempt]

    def log(self, attempt: int = 1, *, job: str = "", run: str = "run") -> list[str]:
        """What the ranks of an attempt printed."""
        return [line.text for line in self.lines(attempt, job=job, run=run) if line.rank is not None]

    def outcome(self, node: int, attempt: int = 1) -> Outcome:
        found = read_outcome(self.run, self.job, attempt, node)
        assert found is not None, (node, self.lines(attempt))
        return found

    def processes(self) -> list[int]:
        """Pids of all that the gangs run."""
        return processes_of(self.store.path)

    def nothing_is_left(self) -> None:
        assert self.processes() == [], "a process of a gang lives"

    def close(self) -> None:
        """Stop all gangs and check that nothing of them is left."""
        for handle in self.handles:
            self.engine.stop(handle, 0.0)
        self.nothing_is_left()
