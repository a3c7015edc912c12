"""The trained cases: a robot's task, with its name in each system, and the common physics, network and steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from shared_store.contract.error_text import nearest

LIMITS = ("theirs", "ours")
"""Sources of the solver's limits."""


@dataclass(frozen=True)
class Limits:
    """Limits of MuJoCo's solver.

    Attributes:
        iterations: Most iterations of the solver.
        ls_iterations: Most iterations of its line search.
        tolerance: Improvement of the cost below which it stops earlier.
    """

    iterations: int
    ls_iterations: int
    tolerance: float


@dataclass(frozen=True)
class Case:
    """One robot to train.

    Attributes:
        name: Its name in the commands.
        task: Muster's task.
        peers: Names of the task in other systems, by the name of the system.
        steps: Control steps of every world in one iteration.
        hidden_sizes: Widths of the hidden layers of actor and critic.
        theirs: The peer's limits of the solver.
        ours: Looser limits, with which Muster trains equally well.
    """

    name: str
    task: str
    peers: Mapping[str, str]
    steps: int
    hidden_sizes: tuple[int, ...]
    theirs: Limits
    ours: Limits

    def limits(self, owner: str) -> Limits:
        """The solver's limits. Raises ValueError if ``whose`` is not one of :data:`LIMITS`."""
        if owner not in LIMITS:
            raise ValueError(f"limits {owner!r}: there are {' and '.join(LIMITS)}")
        return self.theirs if owner == "theirs" else self.ours

    def named_in(self, peer: str) -> str:
        """The task's name in ``peer``. Raises ValueError if the peer lacks it."""
        if peer in ("muster", "rsl_rl"):
            return self.task
        if peer not in self.peers:
            able = ", ".join(name for name, case in CASES.items() if peer in case.peers)
            raise ValueError(f"case {self.name}: {peer} has no such task; its cases are {able}")
        return self.peers[peer]

    def shared(self, peer: str, owner: str) -> dict[str, Any]:
        """Its settings for a training, as plain values: ``task``, ``steps``, ``hidden_sizes``, ``limits``."""
        task, limits = self.named_in(peer), asdict(self.limits(owner))
        return {"task": task, "steps": self.steps, "hidden_sizes": list(self.hidden_sizes), "limits": limits}


def _walking(name: str, task: str, mjlab: str) -> Case:
    # mjlab's own limits are those of its velocity_env_cfg.py, and its tolerance MuJoCo's
    theirs, ours = Limits(10, 20, 1e-8), Limits(4, 8, 1e-8)
    return Case(name, task, {"mjlab": mjlab}, 24, (512, 256, 128), theirs, ours)


def _running(name: str, task: str, isaaclab: str) -> Case:
    # Isaac Lab leaves the solver at its MJWarpSolverCfg's 100 and 50
    return Case(name, task, {"isaaclab": isaaclab}, 32, (400, 200, 100), Limits(100, 50, 1e-6), Limits(3, 6, 1e-3))


CASES: Mapping[str, Case] = {
    case.name: case
    for case in (
        _walking("go1", "Go1Flat", "Mjlab-Velocity-Flat-Unitree-Go1"),
        _walking("g1", "G1Flat", "Mjlab-Velocity-Flat-Unitree-G1"),
        _walking("go1-rough", "Go1Rough", "Mjlab-Velocity-Rough-Unitree-Go1"),
        _walking("g1-rough", "G1Rough", "Mjlab-Velocity-Rough-Unitree-G1"),
        _running("ant", "Ant", "Isaac-Ant"),
        _running("humanoid", "Humanoid", "Isaac-Humanoid"),
    )
}
"""All cases by name."""


def find_case(name: str) -> Case:
    """The case of this name. Raises ValueError with the nearest name if it does not exist."""
    if name not in CASES:
        raise ValueError(f"there is no case {name!r}; {nearest(name, CASES)}")
    return CASES[name]
