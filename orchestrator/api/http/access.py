"""Access to the server: by a token, by a key, by a session of the console, or as the controller's own user."""

from __future__ import annotations

import hmac
import re
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import sha256

from orchestrator.api.http.callers import user_name
from orchestrator.domain.identifiers import ACCESS_KEY_ID
from orchestrator.persistence.access_keys import Key, KeyStore
from orchestrator.services.permissions import CONTROLLER, Actor, Refusal

SESSION = 12 * 3600
"""Seconds for which a login to the console lasts."""
_TOKEN = "token"
"""In a session, in place of an access key id: it was opened with MUSTER_TOKEN."""


@dataclass
class Access:
    """The ways to be admitted: the keys of the database, one token that may do everything, or the controller's own user."""

    keys: KeyStore | None = None
    token: str | None = None
    exposed: bool = False
    """Whether other machines can reach the server, or keys have existed: from then on authentication is always required."""
    reachable: bool = False
    """Whether other machines can reach the server: then nobody makes or deletes keys through it."""
    user: int | None = None
    """Uid of the processes whose requests are taken while no key is demanded; None for an application without a socket."""
    own_token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)
    """Admits this process to its own server (`muster run`), whatever others need."""
    console_secret: bytes = field(default_factory=lambda: secrets.token_bytes(32), repr=False)
    """Signs the console's sessions and forms; the same after a restart, so that open pages continue to work."""
    _ended: dict[str, float] = field(default_factory=dict, repr=False)
    """Sessions that were closed by their users, and when they would have expired."""

    def known(self) -> Mapping[str, Key]:
        """The keys in force, by access key id."""
        return self.keys.current() if self.keys else {}

    def is_new(self, access_key_id: str) -> bool:
        """Whether another process may just have made the key of this id: then :meth:`reload` before it is refused."""
        return (
            self.keys is not None
            and access_key_id not in self.known()
            and bool(re.fullmatch(ACCESS_KEY_ID, access_key_id))
        )

    def reload(self) -> None:
        """Read the keys of the database; the caller's thread may wait for it."""
        if self.keys:
            self.keys.refresh()

    def demanded(self) -> bool:
        """Whether requests must be authenticated. Once keys have existed this stays so: deleting or damaging them opens nothing."""
        if not self.exposed:
            self.exposed = bool(self.token or (self.keys and not self.keys.is_empty))
        return self.exposed

    def admitted(self) -> str:
        """The callers that are admitted now, in one line."""
        if not self.demanded():
            name = "anybody" if self.user is None else f"user {user_name(self.user)} of this machine"
            return f"open to {name}, without a key; `muster keys create NAME` lets others in, and then everybody needs a key"
        with_token = " or MUSTER_TOKEN" if self.token else ""
        return f"open to callers with a key{with_token}; `muster keys list` shows the keys"

    def way_in(self) -> str:
        """Where a refused caller gets a key."""
        if self.token or self.known():
            return "`muster keys list` shows the keys, `muster keys create NAME` creates one"
        return "this controller has no key: on its machine, `muster keys create NAME` creates one"

    def bearer(self, credential: str) -> Actor:
        """The owner of this token, or of ``ACCESS_KEY_ID:SECRET`` of a key. Raises Refusal."""
        if self.own_token and hmac.compare_digest(credential.encode(), self.own_token.encode()):
            return CONTROLLER
        return self._proven(credential)[1]

    def sign_in(self, credential: str) -> str:
        """Open a session for the server's token or a key; its text reveals nothing of the secret. Raises Refusal."""
        if self.is_new(credential.partition(":")[0]):
            self.reload()
        name, _ = self._proven(credential)
        claim = f"{name}.{int(time.time()) + SESSION}.{secrets.token_urlsafe(16)}"
        return f"{claim}.{self._seal(name, claim)}"

    def session(self, credential: str) -> Actor | None:
        """The owner of this session; None where it has expired, was closed, or its key is gone."""
        claim, _, seal = credential.rpartition(".")
        name, _, rest = claim.partition(".")
        expected = self._seal(name, claim)
        if expected is None or not hmac.compare_digest(seal.encode(), expected.encode()) or credential in self._ended:
            return None
        if int(rest.partition(".")[0]) < time.time():
            return None
        return Actor("MUSTER_TOKEN") if name == _TOKEN else actor_of_key(self.known()[name])

    def actor_named(self, name: str) -> Actor | None:
        """The actor of this name with the rights that it has now; None where it has none any more."""
        if not name.startswith("key "):
            return actor if self.still_admits(actor := Actor(name), "") else None
        return next((actor for key in self.known().values() if (actor := actor_of_key(key)).name == name), None)

    def still_admits(self, actor: Actor, session: str) -> bool:
        """Whether a caller who was admitted as ``actor`` would be admitted now; ``session``: the caller's, empty without one."""
        if session:
            return self.session(session) == actor
        if not self.demanded() or actor == CONTROLLER:
            return True
        of_token = self.token is not None and actor == Actor("MUSTER_TOKEN")
        return of_token or any(actor_of_key(key) == actor for key in self.known().values())

    def sign_out(self, credential: str) -> None:
        """Close a session; a restart of the server forgets that, and the session's own end does not."""
        now = time.time()
        for each, end in list(self._ended.items()):  # not a new dict: others close theirs meanwhile
            if end <= now:
                self._ended.pop(each, None)
        if self.session(credential) is not None:
            self._ended[credential] = now + SESSION

    def form_token(self, session: str) -> str:
        """The token that a form of the console must send back: other web pages can't know it. ``session``: empty where none is needed."""
        return hmac.new(self.console_secret, f"form\0{session}".encode(), sha256).hexdigest()

    def _seal(self, name: str, claim: str) -> str | None:
        """The signature of a session, which depends on its key's secret; None without such a key."""
        key = self.known().get(name)
        secret = self.token if name == _TOKEN else key.secret if key else None
        if not secret:
            return None
        return hmac.new(self.console_secret, f"session\0{secret}\0{claim}".encode(), sha256).hexdigest()

    def _proven(self, credential: str) -> tuple[str, Actor]:
        """The credential's name in sessions, and its owner. Raises Refusal."""
        if self.token and hmac.compare_digest(credential.encode(), self.token.encode()):
            return _TOKEN, Actor("MUSTER_TOKEN")
        access_key_id, _, secret = credential.partition(":")
        key = self.known().get(access_key_id)
        if key and hmac.compare_digest(secret.encode(), key.secret.encode()):
            return access_key_id, actor_of_key(key)
        raise Refusal(
            "UnrecognizedClientException",
            f"this token is unknown: set MUSTER_TOKEN to the server's token, or to ACCESS_KEY_ID:SECRET of a key; {self.way_in()}",
        )


def actor_of_key(key: Key) -> Actor:
    """The user of a key."""
    return Actor(f"key {key.name}", None if key.queues is None else frozenset(key.queues), key.read_only, key.share)
