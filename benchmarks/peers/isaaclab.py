"""Wall time of Isaac Lab on its Newton backend, in its own environment, with its own entry point, TensorBoard and checkpoints.

    python -m benchmarks.peers.environment isaaclab
    python -m benchmarks.peers.isaaclab [--case ant] [--limits theirs] [--frontend torch] [--worlds 4096] [--out DIRECTORY]

Writes a record (JSON) of each training into ``--out``; ``python -m benchmarks.peers.table`` makes the table of all records.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from benchmarks.peers.cases import Case
from benchmarks.peers.environment import ASSETS, FOLDER
from benchmarks.peers.run import cases_of, measure, options_of, other_process

FRONTENDS = ("torch", "warp")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = options_of("isaaclab", __doc__, cases_of("isaaclab"))
    parser.add_argument("--environment", type=Path, default=FOLDER / "isaaclab", help="folder of its environment")
    parser.add_argument("--frontend", default=FRONTENDS[0], help="torch, or warp, which it calls experimental")
    measure("isaaclab", parser, _command, arguments)


def _command(options: argparse.Namespace, case: Case, requested: str) -> tuple[list[str], dict[str, str]]:
    if options.frontend not in FRONTENDS:
        raise ValueError(f"--frontend {options.frontend}: there are {' and '.join(FRONTENDS)}")
    words, variables = other_process(options.environment / "bin" / "python", "train_isaaclab.py")
    assets = (options.environment / ASSETS).absolute()
    if not assets.is_dir():
        raise ValueError(
            f"there are no robots in {assets}; python -m benchmarks.peers.environment isaaclab puts them there"
        )
    reported = json.dumps({**json.loads(requested), "frontend": options.frontend})
    return [*words, reported], {**variables, "ISAACSIM_ASSET_ROOT": str(assets), "OMNI_KIT_ACCEPT_EULA": "yes"}


if __name__ == "__main__":
    main()
