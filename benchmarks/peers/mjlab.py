"""Wall time of mjlab in its own environment, with its own training script, TensorBoard and checkpoints.

    python -m benchmarks.peers.environment mjlab
    python -m benchmarks.peers.mjlab [--case go1] [--limits theirs] [--worlds 4096] [--out DIRECTORY]

Writes a record (JSON) of each training into ``--out``; ``python -m benchmarks.peers.table`` makes the table of all records.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.peers.cases import Case
from benchmarks.peers.environment import FOLDER
from benchmarks.peers.run import cases_of, measure, options_of, other_process


def main(arguments: Sequence[str] | None = None) -> None:
    parser = options_of("mjlab", __doc__, cases_of("mjlab"))
    parser.add_argument("--environment", type=Path, default=FOLDER / "mjlab", help="folder of its environment")
    measure("mjlab", parser, _command, arguments)


def _command(options: argparse.Namespace, case: Case, requested: str) -> tuple[list[str], dict[str, str]]:
    words, variables = other_process(options.environment / "bin" / "python", "train_mjlab.py")
    # it draws videos with OpenGL on request, which this never makes
    return [*words, requested], {**variables, "WANDB_MODE": "disabled", "MUJOCO_GL": "disable"}


if __name__ == "__main__":
    main()
