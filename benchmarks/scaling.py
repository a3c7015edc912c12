"""Weak scaling over several GPUs: the same number of worlds per GPU on 1, 2, 4 … GPUs, with collectives between the graphs.

    python -m benchmarks.scaling [--task Ant] [--worlds 4096] [--gpus 1 2 4] [--out DIRECTORY]

Writes ``scaling.md`` and ``scaling.json``. The ranks are started by torchrun and meet as under Muster's supervisor. The last row has half
of the GPUs on each of two "hosts": network namespaces, connected for NCCL only by TCP over a virtual cable.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.load import Watch, add_option, reported
from tests.support.hosts import start_ranks, two_hosts

ITERATIONS = 60


def rank(task: str, worlds: int, store: Path, result: Path) -> None:
    """One rank: train, and on rank 0 record the time per iteration."""
    import torch

    from benchmarks.training import build

    faulthandler.dump_traceback_later(140, exit=True)  # the excess of the slowest rank
    runner = build(task, worlds, store)
    slowest = []
    for _ in range(6):
        runner._iterate()
    torch.cuda.synchronize()
    started = time.perf_counter()
    for _ in range(ITERATIONS):
        slowest.append(runner._iterate()[0].get("slowest_excess", 0.0))
    torch.cuda.synchronize()
    seconds = (time.perf_counter() - started) / ITERATIONS
    record = runner._iterate()[0]
    if runner.gang.is_main:
        found = {
            "seconds": seconds,
            "collect": record["collect_seconds"],
            "learn": record["learn_seconds"],
            "excess": statistics.median(slowest),
            "rate": runner.gang.size * worlds * runner.config.ppo.steps / seconds,
            "captured": [part.name for part in runner.algorithm.graphs if part.captured],
        }
        result.write_text(json.dumps(found))
    runner.close()
    os._exit(0)


def launch(gpus: int, options: argparse.Namespace) -> dict[str, Any]:
    """Train on ``gpus`` GPUs."""
    with tempfile.TemporaryDirectory() as directory:
        result = Path(directory) / "result.json"
        command = [
            *(sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={gpus}", "-m"),
            *("benchmarks.scaling", "--rank", directory, "--task", options.task, "--worlds", str(options.worlds)),
        ]
        env = {**os.environ, "OMP_NUM_THREADS": "4"}
        subprocess.run(command, env=env, check=True, timeout=150)
        return {"gpus": gpus, **json.loads(result.read_text())}


def launch_hosts(gpus: int, options: argparse.Namespace) -> dict[str, Any]:
    """Train on ``gpus`` GPUs of two hosts. Raises OSError if the hosts can't be made."""
    with tempfile.TemporaryDirectory() as directory, two_hosts():
        arguments = ["-m", "benchmarks.scaling", "--rank", directory, "--task", options.task]
        ranks = start_ranks([*arguments, "--worlds", str(options.worlds)], gpus, {})
        try:
            for process in ranks:
                if code := process.wait(150):
                    raise subprocess.CalledProcessError(code, process.args)
        finally:
            for process in ranks:
                process.kill()
        return {"gpus": gpus, "hosts": 2, **json.loads((Path(directory) / "result.json").read_text())}


def _counts() -> list[int]:
    """1, 2, 4 … up to the number of GPUs."""
    import torch

    return [count for count in (1, 2, 4, 8) if count <= max(1, torch.cuda.device_count())]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Ant")
    parser.add_argument("--worlds", type=int, default=4096, help="of each GPU")
    parser.add_argument("--gpus", nargs="+", type=int, default=_counts())
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    add_option(parser)
    parser.add_argument("--rank", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.rank:
        rank(options.task, options.worlds, options.rank / "store", options.rank / "result.json")
    watch = Watch(options.loaded_anyway)
    rows = []
    most = max(options.gpus)
    cases = [(gpus, launch) for gpus in options.gpus] + ([(most, launch_hosts)] if most > 1 else [])
    for gpus, start in cases:
        try:
            rows.append(start(gpus, options) | watch.check(f"while {gpus} GPUs were measured"))
        except (subprocess.SubprocessError, OSError) as error:
            rows.append({"gpus": gpus, "error": str(error)[:300]})
        print(rows[-1], flush=True)
        (options.out / "scaling.json").write_text(json.dumps(rows, indent=1))
    (options.out / "scaling.md").write_text(table(options, rows))


def table(options: argparse.Namespace, rows: list[dict[str, Any]]) -> str:
    """Markdown."""
    import torch

    single = next((row["rate"] for row in rows if row["gpus"] == 1), float("nan"))
    lines = [
        f"# {options.task} on several {torch.cuda.get_device_name()}",
        "",
        f"{options.worlds:,} worlds a GPU, NCCL; steps/s of all together, in millions; efficiency against one GPU. {reported(rows)}",
        "",
        "| GPUs | training | efficiency | iteration | collect | learn | slowest rank |",
        "|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row in rows:
        if "error" in row:
            lines.append(f"| {row['gpus']} | failed | | | | | |")
            continue
        where = " on two hosts, TCP" if "hosts" in row else ""
        lines.append(
            f"| {row['gpus']}{where} | **{row['rate'] / 1e6:.2f}** | {100 * row['rate'] / row['gpus'] / single:.1f} % | "
            f"{1000 * row['seconds']:.1f} ms | {1000 * row['collect']:.1f} ms | {1000 * row['learn']:.1f} ms | "
            f"+{100 * row['excess']:.1f} % |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
