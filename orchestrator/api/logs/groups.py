"""Log groups, their settings and tags, and the streams that clients create: what scripts and Terraform prepare before a job logs."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from orchestrator.api.batch.members import check_log_group
from orchestrator.api.batch.value_checks import check_tags
from orchestrator.api.logs.errors import LogsError, absent, invalid, present
from orchestrator.api.logs.log_events import stored_bytes
from orchestrator.api.logs.streams import Stream, find_stream, newest_streams
from orchestrator.control.controller import Controller
from orchestrator.domain.errors import RequestError
from orchestrator.domain.gang import LOG_GROUP
from orchestrator.persistence import log_groups
from orchestrator.persistence.batch_models import Job, Node
from orchestrator.persistence.own_models import LogGroup, LogStream
from orchestrator.services import permissions
from orchestrator.services.arns import log_group_arn
from orchestrator.services.permissions import Actor, Operation
from shared_store.volume.layout import Store

_RETENTIONS = (
    *(1, 3, 5, 7, 14, 30, 60, 90, 120, 150, 180, 365, 400, 545, 731, 1096, 1827, 2192, 2557, 2922, 3288),
    3653,
)
"""Days, as on AWS."""
_MOST_CREATED = 1000
"""Streams that clients may create in a group."""
_STREAM = re.compile(r"[^:*\0]{1,512}")


# -- the group of a request -------------------------------------------------------------------------------------------


def named_by(session: Session, request: dict[str, Any]) -> str:
    """Name of the group in ``logGroupName`` or ``logGroupIdentifier``. Raises LogsError where it does not exist."""
    named = [request[key] for key in ("logGroupName", "logGroupIdentifier") if key in request]
    if len(named) != 1:
        raise invalid("Exactly one of logGroupName and logGroupIdentifier is needed.")
    return existing(session, named[0])


def existing(session: Session, reference: str) -> str:
    """Name of the group that a name or an ARN means. Raises LogsError where it does not exist."""
    name = _name(reference)
    if name != LOG_GROUP and session.get(LogGroup, name) is None:
        raise absent("log group", reference)
    return name


def _name(reference: str) -> str:
    return reference.removeprefix(log_group_arn("")).removesuffix(":*")


def _group(session: Session, actor: Actor, reference: str, operation: Operation) -> LogGroup:
    """The row of a group, where the caller may do this to it. Raises LogsError, Refusal."""
    group = session.get(LogGroup, existing(session, reference)) or LogGroup(name=LOG_GROUP, owner=None, tags={})
    actor.check(operation, group)
    return group


# -- what is read -----------------------------------------------------------------------------------------------------


def describe_log_groups(controller: Controller, actor: Actor, request: dict[str, Any]) -> dict[str, Any]:
    """DescribeLogGroups: by name, those that fit the request."""
    prefix, pattern = request.get("logGroupNamePrefix"), request.get("logGroupNamePattern")
    if prefix is not None and pattern is not None:
        raise invalid("logGroupNamePrefix and logGroupNamePattern are mutually exclusive.")
    token = request.get("nextToken", "after/")
    if not token.startswith("after/"):
        raise invalid("The specified nextToken is invalid.")
    if request.get("logGroupClass", "STANDARD") != "STANDARD":
        return {"logGroups": []}
    identifiers = {_name(each) for each in request.get("logGroupIdentifiers") or ()}
    size = request.get("limit", 50)
    with controller.database.session() as session:
        rows = {row.name: row for row in session.scalars(select(LogGroup))}
        rows.setdefault(LOG_GROUP, LogGroup(name=LOG_GROUP))
        names = sorted(
            name
            for name in rows
            if name > token.removeprefix("after/")
            and name.startswith(prefix or "")
            and (pattern or "") in name
            and (not identifiers or name in identifiers)
        )
        streams = {
            name: newest_streams(session, actor, controller.access.store, (name,))
            for name in names[:size]
            if pattern is None
        }
        rows[LOG_GROUP].created_at = session.scalar(select(func.min(Job.created_at))) or 0
        session.expunge_all()
    found = [_describe(rows[name], streams.get(name)) for name in names[:size]]  # the store may hang, the database not
    return {"logGroups": found, **({"nextToken": f"after/{names[size - 1]}"} if len(names) > size else {})}


def _describe(group: LogGroup, streams: Sequence[Stream] | None) -> dict[str, Any]:
    """``streams``: of the group; None: the members that AWS gives where a pattern was asked for. Raises OSError."""
    arn = log_group_arn(group.name)
    described: dict[str, Any] = {"logGroupName": group.name, "creationTime": group.created_at, "arn": f"{arn}:*"}
    if streams is not None:
        size = sum(stored_bytes(stream.path) for stream in streams)
        described |= {"metricFilterCount": 0, "storedBytes": size, "logGroupClass": "STANDARD", "logGroupArn": arn}
        described |= {"retentionInDays": group.retention} if group.retention else {}
    return described


def list_tags_for_resource(controller: Controller, actor: Actor, request: dict[str, Any]) -> dict[str, Any]:
    """ListTagsForResource: the tags of the group with this ARN."""
    with controller.database.session() as session:
        return {"tags": _group(session, actor, request["resourceArn"], Operation.LIST_TAGS_FOR_RESOURCE).tags}


# -- what is written --------------------------------------------------------------------------------------------------


def write(controller: Controller, actor: Actor, operation: str, request: dict[str, Any]) -> None:
    """Carry out one of :data:`WRITES`. Raises LogsError, RequestError; DatabaseError where the database can't be written."""
    controller.writes.check(adds=operation.startswith(("Create", "Put", "Tag")))
    with controller.writes.session() as session:
        WRITES[operation](actor, (session, controller.access.store), request)


_Place = tuple[Session, Store]


def create_log_group(actor: Actor, place: _Place, request: dict[str, Any]) -> None:
    """CreateLogGroup: the caller's own, empty."""
    session, name, owner = place[0], request["logGroupName"], actor.name
    check_log_group("logGroupName", name)
    tags = request.get("tags") or {}
    check_tags(tags)
    if request.get("logGroupClass", "STANDARD") != "STANDARD":
        raise invalid(
            f"logGroupClass {request['logGroupClass'][:40]!r} is not supported; use STANDARD, or leave it out"
        )
    for key in ("kmsKeyId", "deletionProtectionEnabled"):
        if request.get(key):
            raise invalid(f"{key} is not supported; leave it out")
    if name == LOG_GROUP or session.get(LogGroup, name) is not None:
        raise present("log group", name)
    try:
        log_groups.check_room(session, [name], owner)
    except RequestError as error:
        raise LogsError("LimitExceededException", str(error)) from None
    session.add(LogGroup(name=name, owner=owner, tags=tags))


def delete_log_group(actor: Actor, place: _Place, request: dict[str, Any]) -> None:
    """DeleteLogGroup: its streams are no longer shown; the files stay with their runs."""
    session, name = place[0], request["logGroupName"]
    if _name(name) == LOG_GROUP:
        actor.check(Operation.DELETE_LOG_GROUP, LogGroup(name=LOG_GROUP))
        raise invalid(f"log group {LOG_GROUP} can't be deleted: jobs that name no group log there")
    group = _group(session, actor, name, Operation.DELETE_LOG_GROUP)
    if (queues := actor.queues) is not None:
        logged = select(Node.job_id).join(Job, Job.id == Node.job_id).where(Node.log_group == group.name)
        if session.scalar(logged.where(Job.queue.not_in(queues)).limit(1)) is not None:
            words = f"log group {group.name} has streams of jobs in other queues; ask for a key with all queues"
            raise permissions.Refusal("AccessDeniedException", f"{Operation.DELETE_LOG_GROUP} is refused: {words}")
    session.execute(update(Node).where(Node.log_group == group.name).values(log_group=""))
    session.delete(group)


def put_retention_policy(actor: Actor, place: _Place, request: dict[str, Any]) -> None:
    """PutRetentionPolicy: kept and shown."""
    days = request["retentionInDays"]
    if days not in _RETENTIONS:
        raise invalid(f"retentionInDays is {str(days)[:30]}; it is one of {', '.join(map(str, _RETENTIONS))}")
    group = _group(place[0], actor, request["logGroupName"], Operation.PUT_RETENTION_POLICY)
    group.retention = days
    place[0].add(group)


def delete_retention_policy(actor: Actor, place: _Place, request: dict[str, Any]) -> None:
    """DeleteRetentionPolicy: none is shown any more."""
    _group(place[0], actor, request["logGroupName"], Operation.DELETE_RETENTION_POLICY).retention = None


def create_log_stream(actor: Actor, place: _Place, request: dict[str, Any]) -> None:
    """CreateLogStream: an empty stream, into which nothing can be written; jobs make their own."""
    (session, store), name = place, request["logStreamName"]
    if not _STREAM.fullmatch(name):
        raise invalid(f"logStreamName {name[:200]!r}: 1 to 512 characters without ':' and '*'")
    group = _group(session, actor, request["logGroupName"], Operation.CREATE_LOG_STREAM)
    if find_stream(session, actor, store, group.name, name, Operation.CREATE_LOG_STREAM) is not None:
        raise present("log stream", name)
    created = select(func.count()).select_from(LogStream).where(LogStream.log_group == group.name)
    if (session.scalar(created) or 0) >= _MOST_CREATED:
        raise LogsError("LimitExceededException", f"log group {group.name} has {_MOST_CREATED} streams of clients")
    session.add(group)
    session.flush()
    session.add(LogStream(log_group=group.name, name=name))


def delete_log_stream(actor: Actor, place: _Place, request: dict[str, Any]) -> None:
    """DeleteLogStream, for those that clients have created."""
    (session, store), name = place, request["logStreamName"]
    group = _group(session, actor, request["logGroupName"], Operation.DELETE_LOG_STREAM)
    if (row := session.get(LogStream, (group.name, name))) is not None:
        session.delete(row)
    elif find_stream(session, actor, store, group.name, name, Operation.DELETE_LOG_STREAM) is None:
        raise absent("log stream", name)
    else:
        raise invalid(f"log stream {name[:300]} is a job's: it is kept as long as the job's history")


def tag_resource(actor: Actor, place: _Place, request: dict[str, Any]) -> None:
    """TagResource, on the ARN of a group."""
    group = _group(place[0], actor, request["resourceArn"], Operation.TAG_RESOURCE)
    tags = {**group.tags, **request["tags"]}
    check_tags(tags)
    group.tags = tags
    place[0].add(group)


def untag_resource(actor: Actor, place: _Place, request: dict[str, Any]) -> None:
    """UntagResource, on the ARN of a group; missing tags are passed over."""
    group = _group(place[0], actor, request["resourceArn"], Operation.UNTAG_RESOURCE)
    group.tags = {key: value for key, value in group.tags.items() if key not in request["tagKeys"]}


WRITES: dict[str, Callable[[Actor, _Place, dict[str, Any]], None]] = {
    "CreateLogGroup": create_log_group,
    "DeleteLogGroup": delete_log_group,
    "PutRetentionPolicy": put_retention_policy,
    "DeleteRetentionPolicy": delete_retention_policy,
    "CreateLogStream": create_log_stream,
    "DeleteLogStream": delete_log_stream,
    "TagResource": tag_resource,
    "UntagResource": untag_resource,
}
