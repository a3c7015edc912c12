"""The wizard's form for the racer's tasks."""

from __future__ import annotations

import json

from orchestrator.console.submit_fields import Field, FieldGroup, TaskForm
from orchestrator.spec.settings import task_config
from racer.control.track_pages import OUTLINE, track_names
from racer.settings.task import RacerConfig

CODE = "reward_function.py"
"""Name of the code in the wizard's editor, as messages give it."""
EXAMPLE = '''def reward_function(params):
    """Keep to the middle of the road, and drive fast."""
    if not params["all_wheels_on_track"]:
        return 1e-3
    middle = 1.0 - (2.0 * params["distance_from_center"] / params["track_width"]) ** 2
    return max(1e-3, middle) * params["speed"]
'''


def _config(task: str) -> type[RacerConfig] | None:
    """The configuration of a racer's task; None of other tasks."""
    kind = task_config(task)
    return kind if isinstance(kind, type) and issubclass(kind, RacerConfig) else None


def _groups(task: str) -> list[FieldGroup]:
    """Track, action space, reward function, hyperparameters."""
    kind = _config(task)
    assert kind is not None
    space = json.dumps(kind().action_space, indent=1, default=dict)
    hint = (
        "In degrees and m/s, as in DeepRacer's model_metadata.json: continuous ranges, or a list of discrete actions."
    )
    tracks = Field(
        "train.config.track",
        "names",
        value="oval",
        placeholder="random:7",
        hint="With several, the worlds take turns.",
        picture=OUTLINE,
    )
    reward = Field("train.config.reward_function", "code", value=EXAMPLE, file=CODE)
    names = [Field(f"train.hyperparameters.{each}") for each in kind.hyperparameters]
    theirs = "DeepRacer's names; they become settings of the algorithm, so give each in one place."
    reward_hint = "Python, as DeepRacer has it: def reward_function(params). Empty: the rewards of the task."
    return [
        FieldGroup("Tracks", (tracks,), True),
        FieldGroup("Action space", (Field("train.config.action_space", "code", value=space),), True, hint=hint),
        FieldGroup("Reward function", (reward,), True, hint=reward_hint),
        FieldGroup("Hyperparameters", tuple(names), hint=theirs),
    ]


FORM = TaskForm("Race", lambda task: _config(task) is not None, _groups, frozenset({"track"}), track_names)
