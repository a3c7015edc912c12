"""One training of Muster as ``muster run`` does it, with its metrics and checkpoints: ``python -m benchmarks.peers.inside.train_muster
JSON``; ``benchmarks.peers.muster`` calls it. The JSON is that of ``train_mjlab.py``, with ``algorithm``."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.peers.building import build_loop
from benchmarks.peers.inside.clock import device_facts, versions
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.metrics import read_metrics

CURVE = {"collect_s": "collect_seconds", "learn_s": "learn_seconds", "seconds": "total_seconds"}
"""Names of these metrics in a point of the curve."""
SHARED = ("env_steps", "reward", "episode_length")


def main() -> None:
    requested: dict[str, Any] = json.loads(sys.argv[1])
    device, wait = device_facts()
    loop = build_loop(requested, Path(requested["logs"]), algorithm=requested["algorithm"])
    wait()
    startup = time.time() - requested["began"]
    loop.train()
    run = loop.job.run
    loop.close()
    records = read_metrics(run)
    curve = [
        {name: record[key] for name, key in CURVE.items()}
        | {name: record[name] for name in SHARED}
        | {name: value for name, value in record.items() if name.startswith("metric_")}
        for record in records
    ]
    at = {record["iteration"]: record["total_seconds"] for record in records}
    checkpoints = [
        {"path": str(run.path.resolve()), "iteration": each.iteration, "seconds": at[each.iteration]}
        for each in list_checkpoints(run)
    ]
    found = {
        "startup_s": startup,
        "curve": curve,
        "checkpoints": checkpoints,
        "device": device,
        "algorithm": requested["algorithm"],
        "solver": {"substeps": loop.task.config.substeps, **loop.task.solver_options},
        "steps": loop.algorithm.steps,
        "settings": dataclasses.asdict(loop.training.settings),
        "versions": versions("muster", "newton", "mujoco-warp", "warp-lang", "torch"),
    }
    Path(requested["out"]).write_text(json.dumps(found, default=str))


if __name__ == "__main__":
    main()
