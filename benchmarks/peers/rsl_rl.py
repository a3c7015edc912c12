"""Wall time of rsl_rl's own runner on Muster's simulation, with TensorBoard and checkpoints.

    python -m benchmarks.peers.rsl_rl [--case go1] [--limits theirs] [--worlds 4096] [--out DIRECTORY]

Writes a record (JSON) of each training into ``--out``; ``python -m benchmarks.peers.table`` makes the table of all records.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from benchmarks.peers.cases import Case
from benchmarks.peers.run import cases_of, measure, options_of, own_process


def main(arguments: Sequence[str] | None = None) -> None:
    measure("rsl_rl", options_of("rsl_rl", __doc__, cases_of("rsl_rl")), _command, arguments)


def _command(options: argparse.Namespace, case: Case, requested: str) -> tuple[list[str], dict[str, str]]:
    words, variables = own_process("train_rsl_rl")
    return [*words, requested], variables


if __name__ == "__main__":
    main()
