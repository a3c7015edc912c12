"""The order in which free resources are offered to a queue's jobs."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from operator import attrgetter
from typing import TypeVar

from orchestrator.scheduling.snapshot import FairShare, Moment, Queue, RoundRobin, Waiting

_T = TypeVar("_T")
_NOMINAL = 60.0
"""Seconds of its resources that a job's share is charged when the job is taken, so that shares take turns in one pass."""
_DEFAULT_DECAY = 600
"""AWS's value for ``shareDecaySeconds`` 0 [s]."""


def decayed(seconds: float, age_seconds: float, decay_seconds: int) -> float:
    """Past use after decay.

    Args:
        seconds: Resource-seconds used.
        age_seconds: Age of that count [s].
        decay_seconds: Its half-life, ``shareDecaySeconds``; 0 stands for AWS's default of 600.
    """
    return float(seconds * 0.5 ** (max(0.0, age_seconds) / (decay_seconds or _DEFAULT_DECAY)))


def weight(policy: FairShare, share: str) -> float:
    """The share's ``weightFactor``: by its name, else by the longest prefix given, else 1."""
    if share in policy.weights:
        return policy.weights[share]
    prefixes = [key for key in policy.weights if key.endswith("*") and share.startswith(key[:-1])]
    return policy.weights[max(prefixes, key=len)] if prefixes else 1.0


def score(queue: Queue, share: str, usage: Mapping[tuple[str, str], float]) -> float:
    """Weighted use of a share; the share with the lowest is served first."""
    return usage.get((queue.name, share), 0.0) * (weight(queue.policy, share) if queue.policy else 1.0)


def dispatch_order(
    queue: Queue | None,
    jobs: Iterable[Waiting],
    usage: Mapping[tuple[str, str], float],
    turns: RoundRobin,
    can_start: Callable[[Waiting], bool],
) -> list[Waiting]:
    """The queue's jobs, the first to be served first.

    Args:
        queue: None for jobs of a queue that does not exist any more.
        jobs: In any order.
        usage: By queue and share.
        turns: As the last pass has left them.
        can_start: Whether a job could start if nothing else ran; one that could not takes no turn.
    """
    if queue is not None and queue.policy is not None:
        return _by_shares(queue, queue.policy, jobs, usage)
    ordered = sorted(jobs, key=attrgetter("created_at", "job"))
    return ordered if queue is None else _by_owners(queue, ordered, turns, can_start)


def _by_owners(
    queue: Queue, jobs: list[Waiting], turns: RoundRobin, can_start: Callable[[Waiting], bool]
) -> list[Waiting]:
    """Jobs, which come by age, so that their owners take turns; the head of the last pass stays the first, lest it never gets its room."""
    if len({job.owner for job in jobs}) < 2:
        return jobs
    lines: dict[str | None, list[Waiting]] = {}
    for job in jobs:
        lines.setdefault(job.owner, []).append(job)
    line_up = sorted(lines, key=lambda owner: turn(turns.served.get((queue.name, owner)), lines[owner][0]))
    ordered = list(in_turns([lines[owner] for owner in line_up], can_start))
    if head := head_of(queue, ordered, turns):
        ordered.remove(head)
        ordered.insert(0, head)
    return ordered


def turn(served: Moment | None, oldest: Waiting) -> tuple[Moment, str]:
    """A key to order who is served next: the least goes first.

    It is the time from which they wait for their turn: their last start (``served``), or their oldest job where that is younger.
    """
    return max(served or (0, 0), (oldest.created_at, 0)), oldest.job


def head_of(queue: Queue, jobs: Iterable[Waiting], turns: RoundRobin) -> Waiting | None:
    """The job, among these, for which the last pass had no room first; None where it has left them."""
    head = turns.heads.get(queue.name)
    return next((job for job in jobs if job.job == head.job), None) if head else None


def in_turns(lines: Iterable[Iterable[_T]], counts: Callable[[_T], bool]) -> Iterator[_T]:
    """The first of each line, then the second of each, and so on; those that do not count are passed beside the next one of their line."""
    left = deque(map(iter, lines))
    while len(left) > 1:
        line = left.popleft()
        for each in line:
            yield each
            if counts(each):
                left.append(line)
                break
    for line in left:
        yield from line


def share_score(
    queue: Queue, ordered: Iterable[Waiting], job: Waiting, usage: Mapping[tuple[str, str], float]
) -> float:
    """Weighted use of the job's share when its turn comes, including the charges of the jobs before it in ``ordered``."""
    share = job.share or ""
    used = score(queue, share, usage)
    charge = _NOMINAL * (weight(queue.policy, share) if queue.policy else 1.0)
    for each in ordered:
        if each is job:
            break
        if (each.share or "") == share:
            used += charge * each.shape.demand
    return used


def _by_shares(
    queue: Queue, policy: FairShare, jobs: Iterable[Waiting], usage: Mapping[tuple[str, str], float]
) -> list[Waiting]:
    """One heap of shares, each with its own jobs in order: O(n log n)."""
    shares: dict[str, list[Waiting]] = {}
    for job in jobs:
        shares.setdefault(job.share or "", []).append(job)
    charges = {share: _NOMINAL * weight(policy, share) for share in shares}
    heap = [(score(queue, share, usage), share) for share in shares]
    heapq.heapify(heap)
    for line in shares.values():
        line.sort(key=lambda job: (-job.priority, job.created_at, job.job), reverse=True)  # served from the end
    ordered: list[Waiting] = []
    while heap:
        used, share = heap[0]
        line = shares[share]
        job = line.pop()
        ordered.append(job)
        if line:
            heapq.heapreplace(heap, (used + charges[share] * job.shape.demand, share))
        else:
            heapq.heappop(heap)
    return ordered
