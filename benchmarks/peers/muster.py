"""Wall time of Muster, training like ``muster run``, with metrics, TensorBoard events and checkpoints.

    python -m benchmarks.peers.muster [--case go1] [--limits theirs] [--worlds 4096] [--algorithm ppo] [--out DIRECTORY]

Writes a record (JSON) of each training into ``--out``; ``python -m benchmarks.peers.table`` makes the table of all records.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence

from benchmarks.peers.cases import Case
from benchmarks.peers.run import cases_of, measure, options_of, own_process

ALGORITHMS = ("ppo", "sac")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = options_of("muster", __doc__, cases_of("muster"))
    parser.add_argument("--algorithm", default=ALGORITHMS[0], help=f"{' or '.join(ALGORITHMS)}")
    measure("muster", parser, _command, arguments)


def _command(options: argparse.Namespace, case: Case, requested: str) -> tuple[list[str], dict[str, str]]:
    if options.algorithm not in ALGORITHMS:
        raise ValueError(f"--algorithm {options.algorithm}: there are {' and '.join(ALGORITHMS)}")
    words, variables = own_process("train_muster")
    return [*words, json.dumps({**json.loads(requested), "algorithm": options.algorithm})], variables


if __name__ == "__main__":
    main()
