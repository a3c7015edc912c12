"""Delivering webhooks: a row for each message, written in the transaction that ends its job, and a thread for each receiver.

A message is delivered at least once: its row goes when the receiver has answered 2xx. It has the same ``webhook-id`` and the same body
at each try. A receiver that is slow or unreachable keeps neither jobs nor other receivers waiting.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from typing import Any

import httpx
from sqlalchemy import ColumnElement, event, func, select, update
from sqlalchemy.orm import Session

from orchestrator import machine
from orchestrator.control.controller import Controller
from orchestrator.control.webhooks import PAUSES, Webhook, event_of, kind_of, run_of
from orchestrator.engines.toolkit.backoff import Backoff
from orchestrator.persistence.batch_models import Job, JobQueue, now
from orchestrator.persistence.own_models import WebhookDelivery
from orchestrator.persistence.ownership import is_of_earlier_run
from orchestrator.persistence.session import DatabaseError
from shared_store import __version__
from shared_store.contract.error_text import nearest
from shared_store.contract.plugins import evaluating
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.evaluations import by_checkpoint, evaluation_name, list_evaluations
from shared_store.volume.layout import Run

TIMEOUT = 10.0
"""Seconds that one try may take in all: connecting, sending, and the response's status."""
_IDLE = 5.0
"""Seconds between two queries for due messages, where nothing wakes the thread."""
_REMOVED = "the webhook was removed from the configuration"
_SHOWN = ("mean_return", "mean_length", "max_length", "episodes")

log = logging.getLogger("muster.webhooks")


class Deliveries:
    """The threads, one for each webhook; :meth:`note` is called by the database as jobs end."""

    def __init__(
        self, controller: Controller, webhooks: Sequence[Webhook], link: str, pauses: Sequence[float] = PAUSES
    ) -> None:
        """``link``: where this controller listens; ``pauses``: seconds after each failed try."""
        self.webhooks = {webhook.name: webhook for webhook in webhooks}
        self._controller, self._database, self._link, self._pauses = controller, controller.database, link, pauses
        self._backoff = Backoff(log)
        self._ending = threading.Event()
        self._wake = {name: threading.Event() for name in self.webhooks}
        self._timeout = TIMEOUT
        self._tls = httpx.create_ssl_context() if webhooks else True  # made once: it takes a while
        self._threads: list[threading.Thread] = []
        if webhooks:
            self._database.ended = self.note

    def start(self) -> None:
        """Deliver the messages that an earlier controller has left, except to webhooks that are not in the file any more."""
        if self.webhooks:  # a controller without any, such as that of `muster run`, leaves what waits to the next one
            with suppress(DatabaseError), self._controller.writes.lock, self._database.session() as session:
                gone = WebhookDelivery.webhook.not_in(list(self.webhooks)), WebhookDelivery.next_at.is_not(None)
                session.execute(update(WebhookDelivery).where(*gone).values(next_at=None, problem=_REMOVED))
                self._name_unknown_queues(session.scalars(select(JobQueue.name)).all())
        for webhook in self.webhooks.values():
            self._threads.append(machine.thread(f"webhook {webhook.name}", partial(self._loop, webhook)))

    def _name_unknown_queues(self, known: Sequence[str]) -> None:
        """Warn of unknown queues in the file; a warning only, since a queue may be created later."""
        for webhook in self.webhooks.values():
            for queue in sorted({*(webhook.queues or ())} - {*known}):
                log.warning(
                    "webhook %s: Job queue %s does not exist; %s",
                    webhook.name,
                    queue[:100],
                    nearest(queue, sorted(known)),
                )

    def close(self) -> None:
        """Deliver no more; due messages wait in the database for the next controller."""
        self._ending.set()
        for wake in self._wake.values():
            wake.set()
        for thread in self._threads:
            thread.join(timeout=1)

    def note(self, session: Session, job: Job) -> None:
        """Add the messages about the end of a job to the transaction that ends it."""
        for webhook in self.webhooks.values():
            if webhook.wants(job):
                made = now()
                session.add(
                    WebhookDelivery(
                        id=f"msg_{uuid.uuid4().hex}", webhook=webhook.name, job=job.id, created_at=made, next_at=made
                    )
                )
                wake = self._wake[webhook.name]
                event.listen(session, "after_commit", lambda _, wake=wake: wake.set(), once=True)

    def test(self, webhook: Webhook) -> dict[str, Any]:
        """Send a sample once; its ``webhook-id``, and the ``problem`` where it was not accepted."""
        identity, timestamp = f"msg_{uuid.uuid4().hex}", _when(now())
        sample = {"type": "webhook.test", "timestamp": timestamp, "data": {"webhook": webhook.name}}
        return {"id": identity, "receiver": webhook.receiver, "problem": self._send(webhook, identity, _json(sample))}

    def described(self, session: Session) -> list[dict[str, Any]]:
        """Each webhook, without its secret: how many messages wait, and the newest that were given up."""
        query = select(WebhookDelivery.webhook, func.count()).where(WebhookDelivery.next_at.is_not(None))
        waiting = {name: count for name, count in session.execute(query.group_by(WebhookDelivery.webhook))}
        return [
            {
                "name": webhook.name,
                "receiver": webhook.receiver,
                "statuses": webhook.statuses,
                "queues": webhook.queues,
                "kinds": webhook.kinds,
                "waiting": waiting.get(webhook.name, 0),
                "problem": self._backoff.failure(webhook.name),
                "failed": _failed(session, WebhookDelivery.webhook == webhook.name),
            }
            for webhook in self.webhooks.values()
        ]

    # -- one receiver -----------------------------------------------------------------------------------------------------

    def _loop(self, webhook: Webhook) -> None:
        wake = self._wake[webhook.name]
        while not self._ending.is_set():
            wake.clear()  # before the query: what is committed after it wakes the thread
            try:
                pause = _IDLE if self._controller.trouble is not None else self._deliver_next(webhook)
            except DatabaseError:  # reported by the controller
                pause = _IDLE
            except Exception as error:
                self._backoff.failed(("bug", webhook.name), f"webhook {webhook.name}: {type(error).__name__}", error)
                pause = _IDLE
            if pause > 0:
                wake.wait(pause)

    def _deliver_next(self, webhook: Webhook) -> float:
        """Try the message that is due first; returns the seconds until there may be another."""
        with self._database.session() as session:
            of_it = WebhookDelivery.webhook == webhook.name, WebhookDelivery.next_at.is_not(None)
            row = session.scalars(
                select(WebhookDelivery).where(*of_it).order_by(WebhookDelivery.next_at).limit(1)
            ).first()
            if row is None or row.next_at is None:
                return _IDLE
            if (early := (row.next_at - now()) / 1000) > 0:
                return min(early, _IDLE)
            body, job = row.body, session.get(Job, row.job)
        if body is None and job is not None:
            body = _json(self._message(webhook, job)).decode()
            with self._controller.writes.session() as session:
                session.get_one(WebhookDelivery, row.id).body = body  # before it is sent: each try has the same
        problem = "its job is forgotten" if body is None else self._send(webhook, row.id, body.encode())
        self._note_try(webhook, row.id, problem, final=body is None)
        return 0.0

    def _note_try(self, webhook: Webhook, identity: str, problem: str | None, *, final: bool) -> None:
        monitoring = self._controller.monitoring
        with self._controller.writes.session() as session:
            row = session.get_one(WebhookDelivery, identity)
            if problem is None:
                session.delete(row)
            else:
                row.tries, row.problem = row.tries + 1, problem
                is_abandoned = final or row.tries > len(self._pauses)
                row.next_at = None if is_abandoned else now() + int(1000 * self._pauses[row.tries - 1])
        if problem is None:
            monitoring.webhook_tried(webhook.name, "delivered")
            if self._backoff.worked(webhook.name):
                log.warning("webhook %s: messages are accepted again", webhook.name)
            return
        self._backoff.failed(webhook.name, f"webhook {webhook.name}: {webhook.receiver} {problem}")
        monitoring.webhook_tried(webhook.name, "given up" if row.next_at is None else "failed")
        if row.next_at is None:
            log.error(
                "webhook %s: message %s about job %s is given up: %s", webhook.name, identity, row.job, row.problem
            )

    def _send(self, webhook: Webhook, identity: str, body: bytes) -> str | None:
        """Try once; returns the problem, None where the receiver accepted the message. Only the status of the response counts.

        It has an event loop of its own: that way a try can be cancelled at any point, such as while a receiver sends a byte a second. Nothing
        of the response is read behind its header.
        """
        headers = {"user-agent": f"muster/{__version__}", **webhook.headers(identity, int(machine.wall()), body)}

        async def deliver() -> str | None:
            async with (
                httpx.AsyncClient(timeout=None, verify=self._tls, follow_redirects=False) as http,
                http.stream("POST", webhook.url, content=body, headers=headers) as response,
            ):
                return None if response.is_success else f"answered {response.status_code}"

        loop = asyncio.new_event_loop()
        try:
            return loop.run_until_complete(asyncio.wait_for(deliver(), self._timeout))
        except TimeoutError:
            return f"has not answered within {self._timeout:g} s"
        except (httpx.HTTPError, httpx.InvalidURL, OSError, ValueError) as error:
            return f"can't be reached ({type(error).__name__})"  # its words may have the URL
        finally:
            loop.close()

    def _message(self, webhook: Webhook, job: Job) -> dict[str, Any]:
        attempts, reason = self._ended(job)
        name = run_of(job)
        checkpoint, summary = _evaluated(self._controller.access.store.run(name), job)
        evaluation = {key: summary[key] for key in _SHOWN} if summary else None
        data = {
            "job": job.id,
            "name": job.name,
            "kind": kind_of(job),
            "queue": job.queue,
            "owner": job.owner,
            "run": name,
            "status": job.status,
            "statusReason": reason,
            "stopped": job.stop_reason is not None,
            "exitCode": attempts[-1] if attempts else None,
            "attempts": len(attempts),
            "createdAt": _when(job.created_at),
            "startedAt": _when(job.started_at),
            "stoppedAt": _when(job.stopped_at),
            "checkpoint": checkpoint,
            "evaluation": evaluation,
            "link": f"{(webhook.link or self._link).rstrip('/')}/api/jobs/{job.id}",
        }
        return {"type": event_of(job.status), "timestamp": _when(job.stopped_at), "data": data}

    def _ended(self, job: Job) -> tuple[list[int | None], str | None]:
        """The exit code of each attempt, and the reason of the job's end."""
        with self._database.session() as session:
            found = session.get_one(Job, job.id)
            return [attempt.exit_code for attempt in found.attempts], found.reason.words or None


def _evaluated(run: Run, job: Job) -> tuple[str | None, Mapping[str, Any] | None]:
    """The checkpoint that a message names, and its evaluation: the evaluated one for a job that evaluates, else the newest."""
    if kind_of(job) == "train" and is_of_earlier_run(job, run):
        return None, None
    with suppress(OSError, ValueError):  # an unavailable volume: the message does without
        if kind_of(job) in evaluating():
            own = (
                each for each in list_evaluations(run) if each["name"] == evaluation_name(each["checkpoint"], job.id)
            )
            summary = next(own, None)
            return (summary["checkpoint"], summary) if summary else (None, None)
        checkpoints = list_checkpoints(run)
        if checkpoints:
            return checkpoints[-1].name, by_checkpoint(run).get(checkpoints[-1].name)
    return None, None


def _failed(session: Session, which: ColumnElement[bool], most: int = 20) -> list[dict[str, Any]]:
    """The newest messages that were given up."""
    query = select(WebhookDelivery).where(which, WebhookDelivery.next_at.is_(None))
    rows = session.scalars(query.order_by(WebhookDelivery.created_at.desc()).limit(most))
    return [
        {"id": row.id, "job": row.job, "createdAt": row.created_at, "tries": row.tries, "problem": row.problem}
        for row in rows
    ]


def _json(value: dict[str, Any]) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()


def _when(milliseconds: int | None) -> str | None:
    """ISO 8601, in UTC."""
    if milliseconds is None:
        return None
    return datetime.fromtimestamp(milliseconds / 1000, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
