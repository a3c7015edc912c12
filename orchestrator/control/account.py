"""The account and the region in a controller's ARNs: chosen at the first ``muster serve`` and kept, since clients remember ARNs."""

from __future__ import annotations

import re
from dataclasses import dataclass

from sqlalchemy import String, cast, func, select, update
from sqlalchemy.orm import Session

from orchestrator.domain.errors import UsageError
from orchestrator.engines.installed import ENGINES
from orchestrator.persistence.batch_models import ComputeEnvironment, Job, JobDefinition, JobQueue, SchedulingPolicy
from orchestrator.persistence.own_models import KnownAccount, LogGroup


@dataclass(frozen=True)
class Account:
    """What stands in ARNs."""

    id: str
    """12 digits."""
    region: str
    partition: str = "aws"
    """``aws-cn`` for regions in China, and so on."""


DEFAULT = Account("000000000000", "us-east-1")


def recognise(session: Session, account: str | None, region: str | None, temporary: bool = False) -> Account:
    """The account of this database, which is remembered at the first start of a controller that is not temporary.

    Where clients of the Batch API have made something before, they know the ARNs of :data:`DEFAULT`, and it stays.

    Args:
        session: On the database.
        account: The id that was asked for; None: as before, at the first start that of :data:`DEFAULT`.
        region: The same.
        temporary: The controller is that of a command, such as ``muster run``.

    Raises:
        UsageError: They are malformed, or not those of the first start.
    """
    known = session.get(KnownAccount, 1)
    if known is None and (not temporary or _has_clients(session)):
        first = (
            (DEFAULT.id, DEFAULT.region) if _has_clients(session) else (account or DEFAULT.id, region or DEFAULT.region)
        )
        known = KnownAccount(id=1, account=first[0], region=first[1])
        session.add(known)
    chosen = account or (known.account if known else DEFAULT.id), region or (known.region if known else DEFAULT.region)
    if known is not None and chosen != (known.account, known.region):
        option = f"--account-id {chosen[0][:40]}" if chosen[0] != known.account else f"--region {chosen[1][:60]}"
        raise UsageError(
            f"{option}: this controller has the ARNs of account {known.account} in {known.region} since its first start, and its "
            "clients know them; leave the option out, or begin anew: another MUSTER_HOME, and another --database where one is used"
        )
    if not re.fullmatch("[0-9]{12}", chosen[0]):
        raise UsageError(f"--account-id {chosen[0][:40]}: expected 12 digits, such as 123456789012")
    found = Account(*chosen, _partition(chosen[1]))
    if found != DEFAULT and known in session.new:  # the definitions of jobs that temporary controllers had
        before, after = (f"arn:{each.partition}:batch:{each.region}:{each.id}:" for each in (DEFAULT, found))
        session.execute(update(Job).values(definition=func.replace(Job.definition, before, after)))
    return found


def _has_clients(session: Session) -> bool:
    """Whether there is anything that Muster's own commands do not make."""
    made = (
        select(JobDefinition.name).where(cast(JobDefinition.document, String).not_like("%MUSTER_SPEC%")),
        select(JobQueue.name).where(JobQueue.name.not_in(["default", *ENGINES])),
        select(ComputeEnvironment.name).where(ComputeEnvironment.name.not_in(list(ENGINES))),
        select(SchedulingPolicy.name),
        select(LogGroup.name),
    )
    return any(session.scalar(each.limit(1)) is not None for each in made)


def _partition(region: str) -> str:
    if region == DEFAULT.region:
        return DEFAULT.partition
    from botocore.exceptions import UnknownRegionError  # sessions take a moment to import
    from botocore.session import get_session

    try:
        return str(get_session().get_partition_for_region(region))
    except UnknownRegionError:
        raise UsageError(f"--region {region[:60]}: expected a region of AWS, such as eu-central-1") from None
