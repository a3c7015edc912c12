"""The start of a node on AWS Batch: ``python -P -m worker.aws_node -- COMMAND…``.

AWS tells a node its index and, a child, the main node's address; what is the same for all nodes Muster's engine has put into
``MUSTER_NODE`` and ``MUSTER_ENVIRONMENT``. From both this makes the node contract, gets the run on the volume ready, and becomes
the node's supervisor: one that also prints its log, for CloudWatch, and on the main node ends the gang when a child dies,
which AWS would not. By a lifeline from each child the main node learns how they end: the kernel closes a dead supervisor's connection
at once, and asks a silent host whether it still runs; nobody has to write anything while all is well. Imports no torch.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import sys
import time
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

from shared_store.contract.node import ContractError, NodeContract, job_variables, sealed
from shared_store.volume.epoch import Claim, StaleEpoch, raise_epoch, read_claim, read_epoch
from shared_store.volume.layout import Run, Store, StoreError
from shared_store.volume.logs import OUTCOME_LINE, format_line, format_lines
from shared_store.volume.node_outcomes import EX_TEMPFAIL, Outcome
from worker.node import supervisor
from worker.node.surroundings import address_towards

PORT = 29499
"""Port of the main node, one below torch.distributed's."""
_KEEPALIVE = {socket.TCP_KEEPIDLE: 5, socket.TCP_KEEPINTVL: 5, socket.TCP_KEEPCNT: 3}
"""A host that is gone is noticed after 5 + 5 * 3 seconds."""
_WORDS = {"gang": str, "node": int, "code": int, "reason": str}
"""The bytes that a child sends; others come from a stranger."""
_ARRIVAL = 1800.0
"""Seconds that a child may take to come after the main node: its instance pulls an image of many gigabytes."""


@dataclass(frozen=True)
class Loss:
    """Why the gang can't go on."""

    reason: str
    exit_code: int
    """The child's, or 1 if it was not observed."""


class MainEnd:
    """The main node's end of all lines. Never waits; to be asked often."""

    def __init__(self, contract: NodeContract) -> None:
        """Listen at the node's address. Raises OSError."""
        self._gang = contract.gang
        self._server = socket.create_server((contract.address or contract.master_address, PORT), backlog=256)
        self._server.setblocking(False)
        self._lines: list[_Line] = []
        self._missing = set(range(contract.node_count)) - {contract.node_index}
        self._deadline = time.monotonic() + _ARRIVAL

    def lost(self) -> Loss | None:
        """The first child that was found to have failed since the last call; None while all is well."""
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._server.accept()
                self._lines.append(_Line(connection))
        found = None
        for line in list(self._lines):
            is_connected = line.read()
            node = line.words.get("node") if line.words.get("gang") == self._gang else None
            self._missing.discard(node)
            if is_connected:
                continue
            self._lines.remove(line)
            code = line.words.get("code")
            if node is None or found is not None or code in (0, EX_TEMPFAIL):
                continue
            if code is None:
                found = Loss(f"node {node} vanished: its supervisor or its host died", 1)
            else:
                found = Loss(f"node {node}: {line.words.get('reason', '')}", code)
        if found is None and self._missing and time.monotonic() > self._deadline:
            found = Loss(f"node {min(self._missing)} has not come within {_ARRIVAL:.0f} s of the main node", 1)
        return found


class _Line:
    """One child's connection and its messages."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection, self._partial = connection, b""
        self.words: dict[str, Any] = {}
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _KEEPALIVE.items():
            connection.setsockopt(socket.IPPROTO_TCP, option, value)

    def read(self) -> bool:
        """Take in what came; False once the line is cut."""
        try:
            while chunk := self._connection.recv(65536):
                *whole, self._partial = (self._partial + chunk).split(b"\n")
                for line in whole:
                    with contextlib.suppress(ValueError, RecursionError):  # a stranger
                        words = json.loads(line)
                        if isinstance(words, dict) and all(type(words[key]) is _WORDS.get(key) for key in words):
                            self.words |= words
        except BlockingIOError:
            return True
        except OSError:
            pass  # reset, or the host does not answer any more
        self._connection.close()
        return False


class ChildEnd:
    """A child node's end of its line."""

    def __init__(self, contract: NodeContract) -> None:
        self._contract = contract
        self._connection: socket.socket | None = None

    def attach(self) -> bool:
        """Reach the main node, which may not listen yet; whether it is reached."""
        if self._connection is None:
            with contextlib.suppress(OSError):
                self._connection = socket.create_connection((self._contract.master_address, PORT), timeout=1.0)
                self._say(gang=self._contract.gang, node=self._contract.node_index)
        return self._connection is not None

    def report(self, exit_code: int, reason: str) -> None:
        """The last word: how the node ended."""
        self._say(code=exit_code, reason=reason)

    def _say(self, **words: object) -> None:
        if self._connection is not None:
            with contextlib.suppress(OSError):
                self._connection.sendall(json.dumps(words).encode() + b"\n")


_PEER_GRACE = 5.0
"""Seconds that the main node's ranks get after a child died: their collectives are broken, there is nothing to save."""
_PATIENCE = 600.0
"""Seconds that a child waits for the main node to take the run: its container starts first, but may be slow."""
_NODE_VARIABLES = ("AWS_BATCH_JOB_NODE_INDEX", "AWS_BATCH_JOB_NUM_NODES", "AWS_BATCH_JOB_MAIN_NODE_INDEX")


class AwsSupervisor(supervisor.Supervisor):
    """A supervisor whose log and outcome are on standard output, too, and that knows how the children end."""

    def __init__(self, contract: NodeContract, run: Run, command: list[str], line: MainEnd | ChildEnd | None) -> None:
        """``line``: to the other nodes; None where a child's death is to change nothing."""
        super().__init__(contract, run, command)
        self._line = line
        self._loss: Loss | None = None

    def write_lines(self, rank: int | None, stream: str, texts: Sequence[str]) -> None:
        super().write_lines(rank, stream, texts)
        _say(format_lines(time.time(), rank, stream, texts))

    def _watch(self) -> None:
        super()._watch()
        if isinstance(self._line, MainEnd) and (loss := self._line.lost()) and self._loss is None:
            self._loss = loss
            self.write(None, "e", f"{loss.reason}; ending the gang")
            self.stop(loss.reason, _PEER_GRACE)

    def _outcome(self, started: float) -> Outcome:
        outcome = super()._outcome(started)
        if self._loss is None or self.stopping != self._loss.reason:
            return outcome  # a rank of this node was first
        code = outcome.exit_code if outcome.exit_code not in (0, EX_TEMPFAIL) else self._loss.exit_code
        return replace(outcome, exit_code=code, signal=None, reason=self._loss.reason, error=None, requested=True)

    def _commit(self, outcome: Outcome) -> int:
        if isinstance(self._line, ChildEnd):
            self._line.report(outcome.exit_code, outcome.reason)
        _say(format_line(time.time(), None, "o", OUTCOME_LINE + json.dumps(asdict(outcome))))
        return super()._commit(outcome)


def _say(line: str) -> None:
    with contextlib.suppress(OSError):
        sys.stdout.write(line)
        sys.stdout.flush()


def complete(env: Mapping[str, str]) -> tuple[NodeContract, dict[str, str]]:
    """The node's contract, and the environment with it: AWS's own variables stay as they are.

    All but one: ``AWS_BATCH_JOB_ATTEMPT`` counts the controller's attempts, each of which is a job of AWS's.

    Raises:
        ContractError: A variable is missing or malformed; the message names it.
    """
    try:
        shared = json.loads(env["MUSTER_NODE"])["contract"]
        variables = json.loads(env.get("MUSTER_ENVIRONMENT", "{}"))
        index, count, main = (int(env[name]) for name in _NODE_VARIABLES)
        address = own_address(env)
        contract = NodeContract(
            node_index=index,
            node_count=count,
            main_index=main,
            master_address=env.get("AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS") or address,
            address=address,
            **{**shared, "array": tuple(shared["array"]) if shared["array"] else None},
        )
    except KeyError as error:
        raise ContractError(f"{error.args[0]} is missing; a node on AWS Batch is started by Muster's engine") from None
    except (ValueError, TypeError) as error:
        raise ContractError(f"MUSTER_NODE is malformed ({error}); it is written by Muster's engine") from None
    kept = {name: value for name, value in env.items() if not name.startswith("MUSTER_")}
    ours = contract.to_env()
    if contract.is_gang:  # a single-node job has none of AWS's node variables
        ours |= {name: value for name, value in env.items() if name.startswith("AWS_")}
    else:
        kept = {name: value for name, value in kept.items() if name not in _NODE_VARIABLES}
        ours["AWS_BATCH_JOB_ID"] = env.get("AWS_BATCH_JOB_ID", contract.job).partition("#")[0]
    ours["AWS_BATCH_JOB_ATTEMPT"] = str(contract.attempt)
    return contract, {**kept, **variables, **sealed(job_variables(env), ours)}


def own_address(env: Mapping[str, str]) -> str:
    """This node's IPv4 address: as configured, as ECS reports of its task, or that of the route to the outside."""
    if env.get("MUSTER_ADDRESS"):
        return env["MUSTER_ADDRESS"]
    if uri := env.get("ECS_CONTAINER_METADATA_URI_V4"):
        with (
            contextlib.suppress(OSError, ValueError, KeyError, IndexError),
            urllib.request.urlopen(uri, timeout=5) as answer,
        ):
            return str(json.load(answer)["Networks"][0]["IPv4Addresses"][0])
    try:
        return address_towards("192.0.2.1")
    except OSError:
        return socket.gethostbyname(socket.gethostname())


def take_run(contract: NodeContract, description: Mapping[str, object], line: MainEnd | ChildEnd | None) -> None:
    """Have the volume's run belong to this attempt: the controller, which has its own store, could not.

    The main node does it, the children wait for it. A run that belongs to a later attempt stays with it; the supervisor refuses.

    Raises:
        StaleEpoch: Another controller's attempt has this epoch.
        StoreError, OSError, ValueError: The volume can't be used.
    """
    run = Store(contract.store).open().run(contract.run)
    if contract.node_index == contract.main_index:
        spec = json.loads(os.environ.get("MUSTER_SPEC") or "null")
        run.create({**description, "created": int(time.time() * 1000), "spec": spec})
        if read_epoch(run) < contract.epoch:
            raise_epoch(run, contract.epoch, Claim("", contract.job, contract.attempt))
        elif (held := read_claim(run, contract.epoch)) and (held.job, held.attempt) != (contract.job, contract.attempt):
            holder = f"attempt {held.attempt} of job {held.job}"
            raise StaleEpoch(f"run {run.name}: {holder} has epoch {contract.epoch} already")
        return
    deadline = time.monotonic() + _PATIENCE
    taken = attached = False
    while not (taken and attached):  # both before anything runs that could fail
        taken = taken or read_epoch(run) >= contract.epoch
        attached = line is None or isinstance(line, MainEnd) or line.attach()
        if time.monotonic() > deadline:
            lacking = "taken the run" if attached else "answered"
            raise StoreError(
                f"the main node, {contract.master_address}, has not {lacking} within {_PATIENCE:.0f} s: see its log; "
                "does the security group let the nodes of a gang talk to each other?"
            )
        time.sleep(0.0 if taken and attached else 0.1)


def main(argv: list[str]) -> int:
    """Entry point; exit codes as the supervisor's."""
    try:
        contract, environment = complete(os.environ)
        description = json.loads(os.environ["MUSTER_NODE"])["description"]
        os.environ.clear()
        os.environ.update(environment)
        line: MainEnd | ChildEnd | None = None
        if contract.node_count > 1 and os.environ.get("MUSTER_ON_CHILD_FAILURE", "ignore") != "ignore":
            line = MainEnd(contract) if contract.node_index == contract.main_index else ChildEnd(contract)
        take_run(contract, description, line)
    except (ContractError, StoreError, OSError, ValueError) as error:
        print(f"muster: node on AWS Batch: {error}", file=sys.stderr)
        return 2
    except StaleEpoch as error:
        print(f"muster: node on AWS Batch: {error}; leaving", file=sys.stderr)
        return 3
    return supervisor.main(argv, partial(AwsSupervisor, line=line))
