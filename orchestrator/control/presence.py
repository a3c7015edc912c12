"""The presence of nodes: those that the bus hears, and what the others' silence proves. Pure: no network, no thread, no clock but the one it gets.

Silence proves nothing by itself: the node may have died, its network may be down, or this controller is the one that is cut off. A node is
lost once it alone has been silent for ``lost_after``, while its engine says that it runs and another node is heard. Otherwise it is
unreachable, and waited for: for five times as long where its engine answers and can't tell, without end where the engine does not answer or
says that it runs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime

from orchestrator import machine
from orchestrator.domain.attempt import UNHEARD
from orchestrator.domain.attempt_events import Silence
from shared_store.contract.bus import Node

LOST_AFTER = 120.0
"""Seconds of silence after which a node is lost, by default."""
UNREACHABLE = 5
"""Times ``lost_after`` for which a node may be unreachable of which its engine can't tell whether it runs."""
_FRESH = 10.0
"""Seconds for which an engine's answer counts, or a quarter of ``lost_after`` where that is more."""
_QUIET = 5.0
"""If no node sends anything for this long, no node counts as heard [s]. A quarter of ``lost_after`` applies where that is more. When a
network is cut, the router removes the nodes one after the other: the token of a node that it has not removed yet proves nothing."""
_BURST = 10.0
"""Seconds within which the nodes fall silent that the controller's own network takes away."""
_FEWEST = 3
"""Nodes below which their silence together says nothing about the controller's network."""
_MISSING = "it has not come to this controller, which took over its job then"
"""Why a node is unreachable that only an earlier controller met."""


@dataclass
class _Seen:
    """A node that this router has met."""

    gone: float | None = None
    """When it fell silent; None while it is heard. This and the other times: seconds of the monotonic clock."""
    since: str = ""
    """The same, for people."""
    answered: float = 0.0
    """From when its engine has answered without a break."""
    confirmed: float = 0.0
    """From when its engine has reported without a break that it runs."""


class Presence:
    """The nodes of all open attempts. Any thread may call."""

    def __init__(
        self,
        lost_after: float = LOST_AFTER,
        monotonic: Callable[[], float] = machine.monotonic,
        wall: Callable[[], float] = machine.wall,
    ) -> None:
        """``lost_after``: seconds; ``monotonic``, ``wall``: the machine's clocks [s]."""
        self.lost_after, self._monotonic, self._wall = lost_after, monotonic, wall
        self._lock = threading.Lock()
        self._expected: dict[tuple[str, int], int] = {}
        self._unmet: dict[tuple[str, int], float] = {}
        """Attempts of which no node has come or ended yet, and since when they are expected."""
        self._nodes: dict[Node, _Seen] = {}
        self._missing: dict[Node, tuple[float, str]] = {}
        """Nodes that an earlier controller met, and this router has not: since when they are expected, and the same for people."""
        self._sign_at = 0.0
        """When a node came or sent something the last time."""
        self._silent = 0
        """How many of them are silent."""
        self._hears_itself = False
        self._cut_off_since: float | None = None
        """Since when the controller may be cut off from its nodes; None while it is not."""
        self._cut_off_at = 0.0
        """When that was so the last time, as far as is known."""
        self._burst: int | None = None
        """How many nodes fell silent together; None where that is to be counted anew."""

    def expect(self, job: str, attempt: int, nodes: int, met: Iterable[int] = ()) -> None:
        """Note an attempt's nodes from now on, until :meth:`forget`; ``met``: those that an earlier controller met."""
        with self._lock:
            if (job, attempt) not in self._expected:
                self._unmet[job, attempt] = self._monotonic()
                self._missing |= {(job, attempt, index): self._moment() for index in met}
            self._expected[job, attempt] = nodes

    def expected(self) -> set[tuple[str, int]]:
        """The jobs and numbers of the attempts whose nodes are expected."""
        with self._lock:
            return set(self._expected)

    def expects(self, node: Node) -> bool:
        """Whether its attempt is open and has such a node."""
        with self._lock:
            return self._expects(node)

    def forget(self, job: str, attempt: int) -> None:
        """The attempt is closed."""
        with self._lock:
            for index in range(self._expected.pop((job, attempt), 0)):
                self._set((job, attempt, index), None)

    def came(self, node: Node) -> None:
        """A node is connected; of one that is not expected nothing is noted."""
        with self._lock:
            if self._expects(node):
                self._set(node, _Seen())
                self._sign_at = self._monotonic()

    def sent(self, node: Node) -> None:
        """A node has sent something: it is there, and the router hears it."""
        with self._lock:
            seen = self._nodes.get(node)
            if seen is not None and seen.gone is None:
                self._note_cut_off()
                self._sign_at = self._monotonic()

    def left(self, node: Node) -> None:
        """A node's connection is gone."""
        now, since = self._moment()
        with self._lock:
            if self._expects(node):
                self._set(node, _Seen(now, since, now, now))

    def ended(self, node: Node) -> None:
        """A node has ended, so that its silence means nothing."""
        with self._lock:
            self._set(node, None)

    def hear_itself(self, arrived: bool) -> None:
        """Whether the router hears the controller's own session, by way of the loopback network."""
        with self._lock:
            self._note_cut_off()
            self._hears_itself = arrived

    def met(self, node: Node) -> bool:
        """Whether the node is or was connected, and has not ended."""
        with self._lock:
            return node in self._nodes

    @property
    def cut_off(self) -> str | None:
        """Why the controller takes itself to be cut off from its nodes; None while it does not, or not for long."""
        with self._lock:
            why = self._note_cut_off()
            since = self._cut_off_since
        return why if since is not None and self._monotonic() - since > UNHEARD else None

    def silence(self, node: Node, age: float | None, runs: bool = True) -> Silence | None:
        """The silence of a node that was connected; None where it is heard, or never was.

        One that was connected to an earlier router only is not lost, however long it is missing: it may look for that one.

        Args:
            node: The node.
            age: Seconds since its engine has answered; None where it does not answer.
            runs: Whether it answered that the node runs; otherwise it can't tell.
        """
        with self._lock:
            now = self._monotonic()
            if (missing := self._missing.get(node)) is not None:
                return Silence(now - missing[0], missing[1], False, _MISSING)
            seen = self._nodes.get(node)
            if seen is None or seen.gone is None:
                return None
            cut_off = self._note_cut_off()
            if age is None or age > min(now - seen.gone, max(_FRESH, self.lost_after / 4)):
                seen.answered = seen.confirmed = now
            if not runs:
                seen.confirmed = now
            alone = now - max(seen.confirmed, self._cut_off_at)
            is_lost = alone > self.lost_after or (not runs and now - seen.answered > UNREACHABLE * self.lost_after)
            return Silence(now - seen.gone, seen.since, is_lost, cut_off or "")

    def _moment(self) -> tuple[float, str]:
        """Now, in seconds of the monotonic clock and for people."""
        return self._monotonic(), f"{datetime.fromtimestamp(self._wall(), UTC):%H:%M:%S} UTC"

    def _expects(self, node: Node) -> bool:
        return 0 <= node[2] < self._expected.get(node[:2], 0)

    def _set(self, node: Node, seen: _Seen | None) -> None:
        """Note what is known of a node; None: nothing."""
        self._note_cut_off()
        self._unmet.pop(node[:2], None)
        self._missing.pop(node, None)
        before = self._nodes.pop(node, None)
        if seen is not None:
            self._nodes[node] = seen
        self._silent += (seen is not None and seen.gone is not None) - (before is not None and before.gone is not None)
        self._burst = None

    def _note_cut_off(self) -> str | None:
        """Why the controller may be the one that is cut off; None while it is not. Before each change: silence counts from its end on."""
        if not self._silent or (why := self._why_cut_off()) is None:
            self._cut_off_since = None
            return None
        self._cut_off_at = self._monotonic()
        self._cut_off_since = self._cut_off_at if self._cut_off_since is None else self._cut_off_since
        return why

    def _why_cut_off(self) -> str | None:
        nodes = len(self._nodes)
        if nodes >= _FEWEST and 2 * (burst := self._silent_together()) > nodes:
            return f"{burst} of {nodes} nodes fell silent within {_BURST:.0f} s, so the controller seems to be cut off"
        quiet = self._monotonic() - self._sign_at
        if nodes > 1 and (nodes == self._silent or quiet > max(_QUIET, self.lost_after / 4)):
            return f"none of {nodes} nodes is heard, so the controller may be cut off"
        if nodes == 1 and not self._hears_itself:
            return "the bus does not hear the controller either"
        gone, recent = next(iter(self._nodes.values())).gone, self._monotonic() - UNREACHABLE * self.lost_after
        # a gang that has not come for longer never does: its hosts can't reach the bus
        if nodes == 1 and gone is not None and any(since > max(gone, recent) for since in self._unmet.values()):
            return "no node of the gangs that were launched since is heard, so the controller may be cut off"
        return None

    def _silent_together(self) -> int:
        """The most nodes that fell silent within one burst."""
        if self._burst is None:
            gone = sorted(each.gone for each in self._nodes.values() if each.gone is not None)
            first = most = 0
            for last, at in enumerate(gone):
                while at - gone[first] > _BURST:
                    first += 1
                most = max(most, last + 1 - first)
            self._burst = most
        return self._burst
