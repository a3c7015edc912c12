"""The limit of a node's memory, as its supervisor keeps it."""

from __future__ import annotations

from shared_store.contract.node import NodeContract
from shared_store.process.memory_groups import killed_for_memory, make_memory_group


class MemoryLimit:
    """What the ranks of a node may use together, with all that they start."""

    def __init__(self, contract: NodeContract) -> None:
        """Make the control group that the contract names, if it names one."""
        self.limit = contract.memory_limit
        """MiB."""
        self.problem = ""
        """Why there is no limit although the contract names one; empty where there is one, or none is wanted."""
        self.group = contract.memory_group
        """Directory of the control group that a rank's command enters; empty for no limit."""
        self._used_up = False
        if self.group:
            try:
                make_memory_group(self.group, self.limit << 20)
            except OSError as error:
                self.problem = f"muster: memory is not limited to {self.limit} MiB: {error.strerror}: {error.filename}"
                self.group = ""

    def is_used_up(self) -> bool:
        """Whether the kernel has ended a process of the node for it."""
        if self.group and not self._used_up:
            self._used_up = killed_for_memory(self.group)
        return self._used_up
