"""Access to the store for use cases: calls with deadlines, users of runs, long texts, and what is known of its volume."""

from __future__ import annotations

from orchestrator.control.disk import Disk
from orchestrator.control.peers import Peers
from orchestrator.control.run_users import RunUsers
from orchestrator.control.store_calls import StoreCalls, StoreSilent
from orchestrator.control.store_identity import StoreIdentity
from shared_store.volume.initial_weights import WeightsCopy
from shared_store.volume.layout import Store


class StoreAccess:
    """Of one controller. Any thread may use it.

    Attributes:
        store: The layout.
        peers: The other controllers of the store.
        disk: Room and presence of its volume.
        calls: Calls for requests.
        followed: Calls for those who follow logs and live pages: each has one at most, however long that takes.
        users: Who uses a run now.
        beginning: Runs that get files before the database has their jobs, by name; nobody else may write them. Changed while
            writes are locked.
    """

    def __init__(self, store: Store, peers: Peers, disk: Disk, identity: StoreIdentity | None = None) -> None:
        """``identity``: of the store; without it whatever is at its path is the store."""
        self.store, self.peers, self.disk, self._identity = store, peers, disk, identity
        self.calls = StoreCalls(store.path, self.problem)
        self.followed = StoreCalls(store.path, self.problem)
        self.users = RunUsers()
        self.beginning: dict[str, WeightsCopy] = {}

    def problem(self) -> str | None:
        """Why the store can't be read; None where it can, as far as was seen."""
        return self.disk.unavailable("store")

    def check(self) -> None:
        """Raises StoreSilent where what is at the store's path now is not the store: what is missing there may be missing for that."""
        if self._identity is not None and (problem := self._identity.problem()) is not None:
            raise StoreSilent(problem)

    def shortage(self) -> str | None:
        """Why nothing large may be written to the store now; None where it may."""
        return self.disk.shortage("store")

    def close(self) -> None:
        """Leave the calls that hang to themselves."""
        self.calls.close()
        self.followed.close()
