"""A controller with its HTTP server in this process, for ``muster serve``, and for ``muster run`` where none is running."""

from __future__ import annotations

import ipaddress
import logging
import os
import re
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from secrets import token_bytes
from typing import Any, cast

import uvicorn

from orchestrator.api.http.access import Access
from orchestrator.api.http.app import BROWSER_HEADERS, create_app
from orchestrator.api.http.connections import Connection, Connections, Seldom, Serving, raise_descriptor_limit
from orchestrator.api.http.limits import RATE, RateLimit
from orchestrator.api.http.request_head import is_loopback
from orchestrator.console import add_console
from orchestrator.control.account import recognise as recognise_account
from orchestrator.control.bus import Bus
from orchestrator.control.compute_environments import ensure_compute_environments, in_order
from orchestrator.control.controller import Controller
from orchestrator.control.deliveries import Deliveries
from orchestrator.control.disk import DEFAULT, MinFree
from orchestrator.control.peers import Peers
from orchestrator.control.presence import LOST_AFTER, Presence
from orchestrator.control.store_identity import recognise
from orchestrator.control.webhooks import WebhooksError, read_webhooks, settle_webhooks
from orchestrator.domain.errors import ServerError, UsageError
from orchestrator.engines.api import EngineError, Setting
from orchestrator.engines.installed import make_engine
from orchestrator.engines.local.gangs import running_gangs
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.secrets import Secrets, SecretsError
from orchestrator.home import HomeLock, open_socket
from orchestrator.persistence.access_keys import KeyStore
from orchestrator.persistence.batch_models import Job
from orchestrator.persistence.home_files import move_in
from orchestrator.persistence.own_secrets import CONSOLE, OwnSecrets
from orchestrator.persistence.session import Database, DatabaseError
from orchestrator.persistence.urls import shown
from orchestrator.plugins import add_plugins
from orchestrator.services import arns
from orchestrator.services.automatic_evaluations import AutomaticEvaluations
from shared_store.contract.plugins import PluginError
from shared_store.volume.layout import Store

log = logging.getLogger("muster.controller")

SHORTEST_TOKEN = 16
"""Characters of a token that lets its bearer do everything."""
_FEWEST_CHARACTERS = 6
_CLIENT = re.compile(r"(MSTR[A-Z2-7]{16}):")
_INVALID = Seldom("Invalid HTTP request received")
_NO_DESCRIPTOR = Seldom("socket.accept() out of system resource")
"""Log lines of uvicorn and asyncio that any client can cause at any rate."""


class Server:
    """Owns the home directory from construction to :meth:`close`."""

    def __init__(
        self,
        home: Path,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        store: str | None = None,
        adopt_store: bool = False,
        token: str | None = None,
        cpus: float | None = None,
        gpus: Sequence[str] | None = None,
        rate_limit: int = RATE,
        submit_rate_limit: int = 0,
        database: str | None = None,
        retention: float | None = None,
        engines: Sequence[str] = ("local",),
        secrets: str | None = None,
        trusted_proxies: Sequence[str] = (),
        min_free: MinFree = DEFAULT,
        lost_after: float = LOST_AFTER,
        squeue_interval: float | None = None,
        webhooks: str | None = None,
        account: str | None = None,
        region: str | None = None,
        temporary: bool = False,
    ) -> None:
        """Take the lock, the port, the engines, the store and the database, in this order; nothing runs until :meth:`start`.

        ``rate_limit``, ``submit_rate_limit``: requests and submissions per second that each key may send; 0: any number.
        ``database``: URL, or path of an SQLite file, where it is not that of the home directory. ``min_free``: what must be free on
        the volumes of the store and the database for something new to start. ``retention``: seconds for which ended jobs are kept, as
        :class:`orchestrator.control.retention.Retention` says. ``engines``: names from :data:`orchestrator.engines.installed.ENGINES`; the queue ``default`` belongs to the
        first, or to the one whose jobs in it are not over.
        ``account``, ``region``: of all ARNs (:mod:`orchestrator.control.account`); None: as before.
        ``temporary``: it goes away with a command that started it; who follows a job then starts another one.
        ``adopt_store``: take what is at the store's path, although the database knows another store.
        ``lost_after``: seconds of a node's silence on the bus after which it may be lost (:mod:`orchestrator.control.presence`).
        ``squeue_interval``: seconds between two calls of ``squeue``; None: as the slurm engine chooses.
        ``secrets``: where the secrets come from that jobs are given (:class:`orchestrator.engines.secrets.Secrets`); None: jobs get none.
        ``webhooks``: path of a file of the receivers of messages about ended jobs (:func:`orchestrator.control.webhooks.read_webhooks`); None:
        those of the database. A ``temporary`` controller has none.
        ``trusted_proxies``: addresses and networks of reverse proxies whose ``X-Forwarded-For`` and ``-Proto`` are believed.

        Raises:
            ServerError, StoreError: One line each: what is in the way, and what to do.
        """
        self._temporary = temporary
        _check_token(token)
        _check_proxies(trusted_proxies)
        exposed = not is_loopback(host) or bool(trusted_proxies)
        with _explained(), ExitStack() as stack:  # whatever fails below, nothing of what came before it is left open
            new_webhooks = None if webhooks is None else read_webhooks(webhooks)
            self._lock = _take_lock(home, temporary)
            stack.callback(self._lock.release)
            self._sockets = [_listen(host, port)]
            stack.callback(self._sockets[0].close)
            if (local := open_socket(home)) is not None:
                self._sockets.append(local)
                stack.callback(local.close)
            # before anything is made in the home directory
            nodes = _make_engines(engines, Setting(home, cpus, gpus, squeue_interval))
            stack.callback(nodes.close)
            if store is None:
                stack.enter_context(_default_store(home / "store"))
            self.store = Store(store or home / "store")
            self.store.check_writable()
            found = Database.at(home, database)
            stack.callback(found.close)
            own = OwnSecrets(found, home)
            self.keys = KeyStore(own)
            move_in(home, own, self.keys)
            console = bytes.fromhex(own.made(CONSOLE, lambda: token_bytes(32).hex()))
            self.access = Access(self.keys, token, exposed, exposed, os.geteuid(), console_secret=console)
            _check_exposure("--trust-proxy" if is_loopback(host) else f"--host {host}", self.access, database)
            stack.callback(self.keys.close)
            nodes.secrets = Secrets(secrets)
            with found.session() as session:
                arns.settle(recognise_account(session, account, region, temporary))
                identity = recognise(session, self.store, adopt_store)
                nodes.arrange(in_order(session, nodes.names))
                ensure_compute_environments(session, nodes.names)
            if any(engine.traits.as_owner for engine in nodes.engines.values()):
                self.store.check_owner()
            receivers = () if temporary else settle_webhooks(own, new_webhooks)
            self.bus = Bus(home, own, nodes.addresses, Presence(lost_after))
            stack.callback(self.bus.close)
            self.peers = Peers(self.store, home, identity.check)
            stack.callback(self.peers.close)
            parts = found, nodes, self.store, self.bus, self.peers
            self.controller = Controller(*parts, retention=retention, min_free=min_free, identity=identity)
            stack.callback(self.controller.close)
            self.evaluations = AutomaticEvaluations(self.controller, self.access.actor_named)
            stack.callback(self.evaluations.close)
            _name_lost_gangs(home, found)
            bound = self._sockets[0].getsockname()[1]
            name = "127.0.0.1" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
            self.url = f"http://{name}:{bound}"
            self.deliveries = Deliveries(self.controller, receivers, self.url)
            stack.callback(self.deliveries.close)
            self.app = create_app(
                self.controller, self.access, RateLimit(rate_limit, submit_rate_limit), self.deliveries
            )
            add_console(self.app)
            add_plugins(self.app)
            self._opened = stack.pop_all()
        connections = Connections(raise_descriptor_limit())
        config = uvicorn.Config(
            self.app,
            http=cast(Any, partial(Connection, connections)),
            ws="none",
            headers=BROWSER_HEADERS,
            log_level="warning",
            access_log=False,
            timeout_graceful_shutdown=2,
            backlog=connections.backlog,
            proxy_headers=bool(trusted_proxies),
            forwarded_allow_ips=list(trusted_proxies),
        )
        logging.getLogger("uvicorn.error").addFilter(_INVALID)
        logging.getLogger("asyncio").addFilter(_NO_DESCRIPTOR)
        self._uvicorn = Serving(config)
        self._thread = threading.Thread(
            target=self._uvicorn.run, kwargs={"sockets": self._sockets}, name="http", daemon=True
        )

    def start(self) -> None:
        """Start the controller and the server, and tell commands on this machine where it is."""
        self.bus.open()
        self.keys.start()
        self.peers.start()
        self.controller.start()
        self.controller.retention.start(self.controller.access.calls.later)
        self.evaluations.start()
        self.deliveries.start()
        self._thread.start()
        self._lock.publish(self.url, self._temporary, arns.here().region, self.controller.database.shown)

    def close(self) -> None:
        """Stop serving; running gangs continue, and the next controller of this home finds them."""
        self._lock.withdraw()
        self.app.state.closing.set()
        self.controller.logs.close()
        self._uvicorn.should_exit = True
        if self._thread.is_alive():
            self._thread.join(timeout=5)
        self._opened.close()


@contextmanager
def _explained() -> Iterator[None]:
    """A block whose errors are those of a start, in one line each."""
    try:
        yield
    except (DatabaseError, EngineError, PluginError, SecretsError, WebhooksError) as error:
        raise ServerError(str(error)) from error


@contextmanager
def _default_store(path: Path) -> Iterator[None]:
    """A context that begins with the directory; it is taken back where nothing came into it, since a volume may belong there."""
    try:
        path.mkdir(mode=0o700)
        made = True
    except OSError:  # it is there, or check_writable() names what is in the way
        made = False
    try:
        yield
    finally:
        if made:
            with suppress(OSError):
                path.rmdir()


def _take_lock(home: Path, temporary: bool) -> HomeLock:
    try:
        return HomeLock(home, temporary)
    except OSError as error:
        raise ServerError(
            f"{home}: can't be used ({error.strerror}); set MUSTER_HOME to a directory that can be written"
        ) from None


def _make_engines(names: Sequence[str], setting: Setting) -> EngineSet:
    """The engines; where one can't be made, those before it are closed. Raises EngineError."""
    with ExitStack() as stack:
        made = []
        for name in dict.fromkeys(names):
            made.append(make_engine(name, setting))
            stack.callback(made[-1].close)
        several = EngineSet(made)
        stack.pop_all()
    return several


def _name_lost_gangs(home: Path, database: Database) -> None:
    """Log gangs of this home that run although the database has no such job: it was deleted, or an older copy was put back."""
    for gang, pids in running_gangs(home).items():
        with database.session() as session:
            if session.get(Job, gang.partition("/")[0]) is not None:
                continue
        log.error(
            "orphaned gang %s runs on this machine, but the database has no such job (was it deleted, or replaced by an older copy?); "
            "terminate it with: kill %s",
            gang,
            " ".join(map(str, pids)),
        )


def _check_exposure(option: str, access: Access, database: str | None) -> None:
    """Raises ServerError where others could come in without a key."""
    if access.exposed and not access.token and not access.known():
        hint = f" (with the same --database as here: {shown(database)})" if database else ""
        raise ServerError(
            f"{option}: the server is reachable from other machines: first create a key with `muster keys create NAME`{hint}, or set "
            "MUSTER_TOKEN to a secret, here and for the clients"
        )


def _check_token(token: str | None) -> None:
    """Raises ServerError for a token that can be guessed, and for a client's key: it would be let in to do everything."""
    if token and (client := _CLIENT.match(token)):
        raise ServerError(
            f"MUSTER_TOKEN is the key {client[1]} of a client, which could do everything here; unset it for `muster serve`, or "
            "give the controller a token of its own"
        )
    if token and (len(token) < SHORTEST_TOKEN or len(set(token)) < _FEWEST_CHARACTERS):
        raise ServerError(
            f"MUSTER_TOKEN is too easy to guess: use at least {SHORTEST_TOKEN} characters, {_FEWEST_CHARACTERS} of them different, "
            "such as those that `openssl rand -hex 24` prints"
        )


def _check_proxies(addresses: Sequence[str]) -> None:
    """Raises UsageError for a text that is neither an address nor a network."""
    for address in addresses:
        try:
            ipaddress.ip_network(address)
        except ValueError as error:
            raise UsageError(
                f"--trust-proxy: {error}; give the proxy's address or network, such as 10.0.0.7 or 10.0.0.0/24"
            ) from None


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        # the protocol by its name: asyncio switches Nagle's algorithm off (40 ms an answer) only where it sees TCP
        listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(128)
        return listener
    except OSError as error:
        raise ServerError(
            f"can't listen on {host}:{port}: {error.strerror or error}; choose another with --port"
        ) from None
