"""Seeds and the states of the global random generators."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch


def mix_seed(*parts: int) -> int:
    """A well-mixed 63-bit seed of ``parts`` (numpy's SeedSequence, which takes no notice of trailing zeros: hence the length)."""
    return int(np.random.SeedSequence((len(parts), *parts)).generate_state(1, np.uint64)[0] >> 1)


def held_out_seed(seed: int) -> int:
    """The seed of the evaluation's worlds for a policy trained with ``seed``; they differ from the training's.

    It has 53 bits, so that readers which know numbers as doubles (jq, JavaScript, tables with missing values) keep it.
    """
    return mix_seed(seed, 4) >> 10


def seed_generators(seed: int, rank: int | None = None) -> None:
    """Seed torch's, numpy's and Python's global generators: alike on all ranks, or each rank its own."""
    value = mix_seed(seed, 2) if rank is None else mix_seed(seed, 3, rank)
    torch.manual_seed(value)
    np.random.seed(value % 2**32)
    random.seed(value)


def generator_state() -> dict[str, Any]:
    """The states of torch's, numpy's and Python's global generators, as tensors and numbers."""
    version, internal, gauss = random.getstate()
    numpy = np.random.get_state(legacy=False)
    keys, position = numpy["state"]["key"], numpy["state"]["pos"]
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state() if torch.cuda.is_available() else None,
        "numpy": {
            "keys": torch.from_numpy(keys.astype(np.int64)),
            "position": position,
            "gauss": [numpy["has_gauss"], numpy["gauss"]],
        },
        "python": {"version": version, "internal": torch.tensor(internal), "gauss": gauss},
    }


def restore_generators(state: dict[str, Any]) -> None:
    """Set the global generators to ``state``, of :func:`generator_state`."""
    torch.set_rng_state(state["torch"])
    if state["cuda"] is not None and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"])
    numpy, python = state["numpy"], state["python"]
    np.random.set_state(("MT19937", numpy["keys"].numpy().astype(np.uint32), numpy["position"], *numpy["gauss"]))
    random.setstate((python["version"], tuple(python["internal"].tolist()), python["gauss"]))
