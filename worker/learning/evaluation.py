"""Deterministic evaluation: the mean action, whole episodes from a fresh reset, the worlds of all ranks."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import torch

from shared_store.files import write_json
from shared_store.layout import Run
from worker.distributed import Gang
from worker.learning.algorithm import Policy
from worker.learning.setup import observed

if TYPE_CHECKING:
    from worker.tasks.task import Task


@dataclass(frozen=True)
class Evaluation:
    """Figures over all episodes of all ranks; lengths in steps."""

    checkpoint: str
    task: str
    episodes: int
    mean_return: float
    std_return: float
    min_return: float
    max_return: float
    mean_length: float
    max_length: int
    """The longest that an episode can be."""
    full_length: float
    """Fraction of the episodes that only the clock ended."""
    seconds: float

    def __str__(self) -> str:
        percent = round(100 * self.mean_length / self.max_length)
        return (
            f"evaluation: mean episode length {self.mean_length:.1f} of {self.max_length} ({percent} %), "
            f"mean return {self.mean_return:.2f} over {self.episodes} episodes"
        )

    def write(self, run: Run) -> str:
        """Write ``evaluations/<checkpoint>.json``; returns its path."""
        path = run.evaluations / f"{self.checkpoint}.json"
        figures = {
            key: value if not isinstance(value, float) or math.isfinite(value) else None
            for key, value in asdict(self).items()
        }
        write_json(path, {**figures, "time": time.time()})
        return str(path)


def evaluate(task: Task, policy: Policy, gang: Gang, *, checkpoint: str, episodes: int | None = None) -> Evaluation:
    """Run at least ``episodes`` episodes, by default one a world; all ranks call it. The worlds are left as they were.

    Every world contributes equally many whole episodes, so that short ones are not counted more often than long ones.
    """
    started = time.perf_counter()
    before = task.state_dict()
    worlds = int(gang.sum(torch.tensor(float(task.world_count), device=gang.device)))
    rounds = 1 if episodes is None else math.ceil(episodes / worlds)
    results = torch.cat([_one_episode(task, policy) for _ in range(rounds)])
    task.load_state_dict(before)
    task.clear_statistics()
    returns, lengths, timed = results.double().unbind(1)
    sums = gang.sum(
        torch.stack([torch.ones_like(returns).sum(), returns.sum(), returns.square().sum(), lengths.sum(), timed.sum()])
    ).tolist()
    extremes = torch.zeros(gang.size, 2, dtype=torch.float64, device=gang.device)
    extremes[gang.rank, 0], extremes[gang.rank, 1] = returns.min(), returns.max()
    gang.sum(extremes)
    count, total, squares, steps, full = sums
    return Evaluation(
        checkpoint=checkpoint,
        task=type(task).__name__,
        episodes=int(count),
        mean_return=total / count,
        std_return=math.sqrt(max(0.0, squares / count - (total / count) ** 2)),
        min_return=float(extremes[:, 0].min()),
        max_return=float(extremes[:, 1].max()),
        mean_length=steps / count,
        max_length=task.max_episode_length,
        full_length=full / count,
        seconds=time.perf_counter() - started,
    )


def _one_episode(task: Task, policy: Policy) -> torch.Tensor:
    """Return, length and whether only the clock ended it, of each world's first episode after a reset: shape (worlds, 3)."""
    task.reset()
    policy.reset()
    observations = observed(task)
    result = torch.zeros(task.world_count, 3, device=task.device)
    running = torch.ones(task.world_count, device=task.device)
    for step in range(task.max_episode_length):
        task.step(policy.act(observations))
        policy.reset(task.dones)
        result[:, 0] += torch.where(running > 0, task.rewards, 0.0)
        result[:, 1] += running
        result[:, 2] += running * (task.time_outs > 0)
        running *= task.dones == 0
        # looking waits for the device, so look seldom; where all episodes are short it saves most of the time
        if step % 32 == 31 and not bool(running.any()):
            break
    return result
