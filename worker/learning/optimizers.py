"""What optimizers take over from a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch


def load_optimizer(optimizer: torch.optim.Optimizer, state: Mapping[str, Any]) -> None:
    """Go on with the moments of a saved ``state``, and with this optimizer's own settings.

    Rates and decays are this job's. The rate may be a tensor that a graph reads; and ``capturable`` is the device's: of a run that began
    on a CPU it is false, and no GPU could record such a step.

    Raises ValueError where the state is that of other parameters.
    """
    own = [{key: value for key, value in group.items() if key != "params"} for group in optimizer.param_groups]
    optimizer.load_state_dict(dict(state))
    for group, settings in zip(optimizer.param_groups, own, strict=True):
        group.update(settings)
