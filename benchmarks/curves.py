"""Whole trainings: reward against time, of each built-in task with its own settings.

    python -m benchmarks.curves [--tasks Ant Humanoid Quadruped] [--worlds 4096] [--iterations 500] [--out DIRECTORY]

Writes ``curves.json``, and ``curves.png`` where matplotlib is installed. The clock starts with the first iteration; what is before
it (imports, worlds, kernels) stands apart.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.gpu import build


def train(task: str, worlds: int, iterations: int, store: Path, seed: int = 0) -> dict[str, Any]:
    """Reward, episode length and seconds after each iteration."""
    started = time.perf_counter()
    runner = build(task, worlds, store, seed)
    built = time.perf_counter() - started
    started = time.perf_counter()
    curve = []
    for _ in range(iterations):
        record = runner._iterate()[0]
        seconds = time.perf_counter() - started
        curve.append([round(seconds, 3), record["env_steps"], record["reward"], record["episode_length"]])
    keep = ("nan_worlds", "solver_overflows", "learning_rate", "kl", "action_std")
    terms = {name: value for name, value in record.items() if name.startswith("reward_") or name in keep}
    return {"task": task, "worlds": worlds, "built_s": built, "seconds": seconds, "last": terms, "curve": curve}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["Cartpole", "Ant", "Humanoid", "Quadruped"])
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as store:
        for task in options.tasks:
            rows.append(train(task, options.worlds, options.iterations, Path(store)))
            steps, reward, length = rows[-1]["curve"][-1][1:]
            print(
                f"{task}: {steps / 1e6:.1f} M steps in {rows[-1]['seconds']:.1f} s; reward {reward}, length {length}",
                flush=True,
            )
            print(rows[-1]["last"], flush=True)
            (options.out / "curves.json").write_text(json.dumps(rows))
    with contextlib.suppress(ImportError):
        draw(rows, options.out / "curves.png")


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Mean return of finished episodes against time, one panel a task."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(rows), figsize=(4 * len(rows), 3), squeeze=False)
    for panel, row in zip(panels[0], rows, strict=True):
        points = [(seconds, reward) for seconds, _, reward, _ in row["curve"] if reward is not None]
        panel.plot(*zip(*points, strict=True))
        panel.set_title(f"{row['task']}, {row['worlds']:,} worlds")
        panel.set_xlabel("seconds of training")
    panels[0][0].set_ylabel("mean return")
    figure.tight_layout()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
