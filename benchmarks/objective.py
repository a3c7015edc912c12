"""The loss of the fused PPO in three forms, in one run: the hand-written kernel, plain torch, and plain torch with torch.compile.

    python -m benchmarks.objective [--tasks Ant Humanoid] [--worlds 4096] [--out DIRECTORY]

Writes ``objective.md``: milliseconds of learning and of an iteration. Everything else is the same, including the captured graphs.
"""

from __future__ import annotations

import argparse
import contextlib
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import torch

from benchmarks.load import Watch, add_option, reported
from benchmarks.training import build, device_name, wait
from worker.learning.ppo import fused, heads
from worker.learning.ppo.rollout_buffer import RolloutBuffer
from worker.settings.ppo import PPOConfig

WAYS = ("kernel", "torch", "torch.compile")
STRETCHES, ITERATIONS = 5, 15


def measure(task: str, worlds: int, way: str) -> dict[str, float]:
    """Medians [ms] of an iteration, and of learning in it, on this device."""
    with contextlib.ExitStack() as stack:
        if way != "kernel":
            stack.enter_context(mock.patch.object(fused, "Gaussian", Plain))
        if way == "torch.compile":
            stack.enter_context(mock.patch.object(Plain, "loss", staticmethod(torch.compile(Plain.loss))))
        loop = build(task, worlds, Path(stack.enter_context(tempfile.TemporaryDirectory())))
        for _ in range(6):
            loop._iterate()
        found = []
        for _ in range(STRETCHES):
            wait()
            started = time.perf_counter()
            learnt = [loop._iterate()[0]["learn_seconds"] for _ in range(ITERATIONS)]
            wait()
            found.append(((time.perf_counter() - started) / ITERATIONS, statistics.median(learnt)))
        loop.close()
    iteration, learn = (1000 * statistics.median(each) for each in zip(*found, strict=True))
    return {"iteration": iteration, "learn": learn}


class Plain(heads.Gaussian):
    """The same loss in plain torch."""

    def __init__(self, actor: Any, samples: int, weight: float, config: PPOConfig) -> None:
        super().__init__(actor, samples, weight, config)
        self._weight, self._config = weight, config

    @staticmethod
    def loss(
        config: PPOConfig,
        samples: heads.Samples,
        actions: torch.Tensor,
        old: Sequence[torch.Tensor],
        new: Sequence[torch.Tensor],
        values: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The loss and its means; ``old`` and ``new``: mean, shape (samples, actions), and standard deviation, shape (actions,)."""
        (old_mean, old_std), (mean, std) = old, new
        half_log_two_pi = 0.9189385332046727
        log_prob = -(0.5 * ((actions - mean) / std).square() + std.log() + half_log_two_pi).sum(1)
        entropy = (0.5 + half_log_two_pi + std.log()).sum().expand(len(mean))
        squares = (old_std / std).square() + ((old_mean - mean) / std).square()
        kl = (0.5 * (squares - 1.0) - (old_std / std).log()).sum(1)
        return heads.clipped_loss(config, samples, log_prob, entropy, kl, values)

    def backward(
        self, rows: torch.Tensor, rollout: RolloutBuffer, outputs: torch.Tensor, values: torch.Tensor
    ) -> torch.Tensor:
        known = rollout.log_prob, rollout.advantages, rollout.returns, rollout.values
        samples = heads.Samples(*(each.flatten()[rows] for each in known))
        old = rollout.outputs.flatten(0, 1)[rows], self.std
        actions = rollout.actions.flatten(0, 1)[rows]
        loss, losses = self.loss(self._config, samples, actions, old, (outputs, self._learnt), values.squeeze(1))
        (self._weight * loss).backward()
        return self._weight * losses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["Ant", "Humanoid"])
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    options = parser.parse_args()
    watch, rows, lines = Watch(options.loaded_anyway), [], []
    for task in options.tasks:
        for way in WAYS:
            found = measure(task, options.worlds, way)
            rows.append(watch.check(f"while {task} was measured"))
            lines.append(f"| {task} | {way} | {found['learn']:.2f} | {found['iteration']:.2f} |")
            print(lines[-1], flush=True)
            head = [
                f"# The loss of the fused PPO on {device_name()}",
                "",
                f"{options.worlds:,} worlds, medians in ms, one run; `python -m benchmarks.objective`. {reported(rows)}",
                "",
                "| task | loss | learning | iteration |",
                "|---|---|--:|--:|",
            ]
            (options.out / "objective.md").write_text("\n".join([*head, *lines]) + "\n")


if __name__ == "__main__":
    main()
