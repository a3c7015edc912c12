"""The account and the region in a controller's ARNs: chosen at its first start and kept, since clients remember ARNs."""

from __future__ import annotations

import re
from dataclasses import dataclass

from sqlalchemy.orm import Session

from orchestrator.domain.errors import UsageError
from orchestrator.persistence.own_models import KnownAccount


@dataclass(frozen=True)
class Account:
    """What stands in ARNs."""

    id: str
    """12 digits."""
    region: str
    partition: str = "aws"
    """``aws-cn`` for regions in China, and so on."""


DEFAULT = Account("000000000000", "us-east-1")


def recognise(session: Session, account: str | None, region: str | None) -> Account:
    """The account of this database, which is remembered at the first start.

    Args:
        session: On the database.
        account: The id that was asked for; None: as before, at the first start that of :data:`DEFAULT`.
        region: The same.

    Raises:
        UsageError: They are malformed, or not those of the first start.
    """
    known = session.get(KnownAccount, 1)
    wanted = account or (known.account if known else DEFAULT.id), region or (known.region if known else DEFAULT.region)
    if known is None:
        session.add(KnownAccount(id=1, account=wanted[0], region=wanted[1]))
    elif wanted != (known.account, known.region):
        option = f"--account-id {wanted[0][:40]}" if wanted[0] != known.account else f"--region {wanted[1][:60]}"
        raise UsageError(
            f"{option}: this controller has the ARNs of account {known.account} in {known.region} since its first start, and its "
            "clients know them; leave the option out, or begin anew: another MUSTER_HOME, and another --database where one is used"
        )
    if not re.fullmatch("[0-9]{12}", wanted[0]):
        raise UsageError(f"--account-id {wanted[0][:40]}: expected 12 digits, such as 123456789012")
    return Account(*wanted, _partition(wanted[1]))


def _partition(region: str) -> str:
    if region == DEFAULT.region:
        return DEFAULT.partition
    from botocore.exceptions import UnknownRegionError  # sessions take a moment to import
    from botocore.session import get_session

    try:
        return str(get_session().get_partition_for_region(region))
    except UnknownRegionError:
        raise UsageError(f"--region {region[:60]}: expected a region of AWS, such as eu-central-1") from None
