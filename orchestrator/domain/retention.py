"""The retention of old jobs and runs: what may go, what is still needed, and why. Pure decisions over facts.

:func:`still_needed` is the one place that knows for what a run is kept. A new kind of thing that needs runs adds
:class:`RetentionReference` values where they are collected (:mod:`shared_store.volume.references`, :mod:`orchestrator.persistence.retention_rows`);
nothing changes here.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from orchestrator.domain.units import SECONDS, amount

A_DAY = 24 * 3600 * 1000
"""Milliseconds."""
BATCH_DAYS = 90
"""For which a job of the Batch API is kept where nobody has set a rule."""
TRIAL_DAYS = 7
"""After an upgrade, in which a controller only logs what it would take."""
TAG = "muster:retention"
"""Tag of a job queue: its rule."""
_LONGEST = 10**6 * A_DAY
OFF = "off"
"""The rule that keeps everything."""
_UNITS = {unit: 1000 * SECONDS[unit] for unit in "mhd"}


def age_of(text: str) -> int:
    """Milliseconds of a time such as ``90d``, ``36h`` or ``45m``. Raises ValueError, in one line."""
    expected = "days, hours or minutes, such as 90d, 36h or 45m"
    try:
        age = int(amount(text, _UNITS, expected))
    except ValueError as error:
        raise ValueError(f"{text[:40]!r}: {error}") from None
    if age > _LONGEST:
        raise ValueError(f"{text[:40]!r}: expected {expected}")
    return age


def rule_of(text: str) -> int | None:
    """The same of a rule; None of :data:`OFF`. Raises ValueError, also where nothing would be kept at all."""
    if text == OFF:
        return None
    try:
        age = age_of(text)
    except ValueError as error:
        raise ValueError(f"{error}, or {OFF} to keep everything") from None
    if not age:
        raise ValueError(
            f"{text[:40]!r}: every job would be deleted as it ends; expected a longer time, or {OFF} to keep everything"
        )
    return age


@dataclass(frozen=True)
class RetentionReference:
    """Something needs a run, or a job."""

    kind: Literal["run", "job"]
    name: str
    """Of the run; id of the job."""
    by: str
    """What needs it, in words that follow "it is kept, since"."""


@dataclass(frozen=True)
class References:
    """Everything that needs a run or a job."""

    found: Mapping[tuple[str, str], Sequence[str]] = field(default_factory=dict)
    """By kind and name: what needs it."""
    unreadable: tuple[str, ...] = ()
    """What could not be read, and may need any run that has results."""
    unknown: tuple[str, ...] = ()
    """What could not be read, and may need any run and any job: folders of plug-ins."""

    @classmethod
    def of(
        cls,
        references: Iterable[RetentionReference],
        unreadable: Iterable[str] = (),
        unknown: Iterable[str] = (),
    ) -> References:
        found: dict[tuple[str, str], list[str]] = {}
        for each in references:
            found.setdefault((each.kind, each.name), []).append(each.by)
        return cls(found, tuple(unreadable), tuple(unknown))

    def to(self, kind: Literal["run", "job"], name: str) -> Sequence[str]:
        """What needs it, or may need everything."""
        return [*self.found.get((kind, name), ()), *self.unknown]

    def unnamed(self) -> References:
        """The same for who may not see everything: that something needs a run, and not what."""
        hidden = ["something needs it, and a key with all queues sees what"]
        damaged = ("something in the store can't be read",)
        unknown = ("something in the store can't be read and may need it, and a key with all queues sees what",)
        return References(
            dict.fromkeys(self.found, hidden), damaged if self.unreadable else (), unknown if self.unknown else ()
        )

    def __or__(self, other: References) -> References:
        keys = self.found.keys() | other.found.keys()
        found = {key: [*self.found.get(key, ()), *other.found.get(key, ())] for key in keys}
        return References(found, (*self.unreadable, *other.unreadable), (*self.unknown, *other.unknown))


@dataclass(frozen=True)
class RunFacts:
    """A run, as the store has it."""

    name: str
    epoch: int = 0
    """The highest that a controller has claimed: another one means that an attempt has started since."""
    results: tuple[str, ...] = ()
    """Files and directories that are neither Muster's records of the run nor its logs and outcomes."""
    logged: frozenset[str] = frozenset()
    """Jobs that have left logs or outcomes there."""
    archived: str | None = None
    """By whom and when; None where it is not archived."""
    writer: str | None = None
    """The attempt of another controller that writes it, in words."""
    damage: str | None = None
    """Why it can't be read."""


@dataclass(frozen=True)
class JobFacts:
    """A job of a run, as the database has it."""

    id: str
    is_open: bool = False
    is_due: bool = False
    """Whether its rule lets it go; never while it is open."""


@dataclass(frozen=True)
class Decision:
    """What goes of a run and its jobs."""

    run: bool
    """Whether the whole run goes."""
    jobs: tuple[str, ...]
    """The jobs that go, with their logs and outcomes."""
    reasons: tuple[str, ...] = ()
    """Why the rest stays; of what is due alone."""


@dataclass(frozen=True)
class RetentionRules:
    """How long jobs are kept. Times are Unix milliseconds.

    Attributes:
        queues: The rule of each queue that has one; None: without end.
        others: Queues without a rule. Jobs of any further queue are kept: with a queue that was deleted its rule went, which may have
            been to keep them.
        default: Of ``others``: for so many milliseconds; None: jobs of the Batch API for :data:`BATCH_DAYS`, where ``batch`` says so,
            and all others without end.
        since: When this database was upgraded to a Muster with these rules; 0 where it was made by one. Of jobs without a rule the time
            counts from then on.
        batch: Whether jobs of the Batch API go without a rule.
    """

    queues: Mapping[str, int | None] = field(default_factory=dict)
    others: Collection[str] = ()
    default: int | None = None
    since: int = 0
    batch: bool = True

    def batch_limit(self, moment: int) -> int | None:
        """Before when a job of the Batch API without a rule must have ended to go at ``moment``; None where none may go yet."""
        limit = moment - BATCH_DAYS * A_DAY
        return limit if self.batch and limit >= self.since else None

    def is_trial(self, moment: int) -> bool:
        """Whether nothing goes by itself yet."""
        return moment < self.since + TRIAL_DAYS * A_DAY


def still_needed(run: RunFacts, jobs: Collection[JobFacts], references: References) -> list[str]:
    """Why nothing of a run may go, whoever asks for it; empty where it may."""
    reasons = [f"job {each.id} has not ended" for each in jobs if each.is_open]
    reasons += references.to("run", run.name)
    reasons += [by for each in jobs for by in references.to("job", each.id)]
    if run.archived is not None:
        reasons.append(f"it is archived ({run.archived})")
    if run.writer is not None:
        reasons.append(f"{run.writer} writes it")
    if run.damage is not None:
        reasons.append(f"it can't be read ({run.damage})")
    if run.results:
        reasons += [f"{each}, and may need it" for each in references.unreadable]
    return list(dict.fromkeys(reasons))


def decide(run: RunFacts | None, jobs: Sequence[JobFacts], references: References) -> Decision:
    """What goes of a run and its jobs by the rules.

    Args:
        run: None where the store has no such run, because its jobs never started or it was deleted.
        jobs: All of its jobs that the database has.
        references: What needs them.
    """
    due = tuple(each.id for each in jobs if each.is_due and not each.is_open)
    if not due:
        return Decision(False, ())
    if run is None:
        kept = [by for job in due for by in references.to("job", job)]
        return Decision(False, tuple(job for job in due if not references.to("job", job)), tuple(dict.fromkeys(kept)))
    if reasons := still_needed(run, jobs, references):
        return Decision(False, (), tuple(reasons))
    reasons = []
    if run.results:
        reasons.append(f"it holds {', '.join(run.results[:3])}{', …' * (len(run.results) > 3)}")
    if strange := run.logged - {each.id for each in jobs}:
        reasons.append(f"it holds logs of job {min(strange)}, which is not in this controller's database")
    if waits := [each for each in jobs if each.id not in due]:
        reasons.append(f"job {waits[0].id} of it is kept longer")
    return Decision(not reasons, due, tuple(reasons))
