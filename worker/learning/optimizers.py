"""Load an optimizer's state from a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch


def load_optimizer(optimizer: torch.optim.Optimizer, state: Mapping[str, Any]) -> None:
    """Load the moments of a saved ``state``, and keep this optimizer's own settings.

    Rates and decays are this job's. The rate may be a tensor that a graph reads; ``capturable`` depends on the device: in the state of a
    run that began on a CPU it is false, and no GPU could capture such a step.

    Raises ValueError if the state belongs to other parameters.
    """
    own = [{key: value for key, value in group.items() if key != "params"} for group in optimizer.param_groups]
    optimizer.load_state_dict(dict(state))
    for group, settings in zip(optimizer.param_groups, own, strict=True):
        group.update(settings)
