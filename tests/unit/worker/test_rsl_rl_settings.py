"""Settings of rsl_rl in a job: what is filled in, what is refused."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from typing import Any

import pytest

from worker.learning.rsl.settings import REFUSED, RslRlConfig, read_settings


def test_settings_are_read_without_torch() -> None:
    code = "import sys; from worker.learning.rsl.settings import read_settings; read_settings({}); print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


def test_a_section_with_a_class_is_taken_as_it_is_and_one_without_changes_the_defaults() -> None:
    given = {"class_name": "MLPModel", "hidden_dims": [7]}
    config = read_settings({"critic": given, "actor": {"hidden_dims": [5], "distribution_cfg": {"init_std": 0.3}}})
    assert config.section("critic") == given
    normal = {"class_name": "GaussianDistribution", "init_std": 0.3}
    expected = {"class_name": "MLPModel", "hidden_dims": [5], "activation": "elu", "obs_normalization": True}
    assert config.section("actor") == {**expected, "distribution_cfg": normal}
    config.section("actor")["distribution_cfg"]["init_std"] = 9.0
    assert RslRlConfig().section("actor")["distribution_cfg"]["init_std"] == 1.0
    assert json.loads(json.dumps(dataclasses.asdict(config)))["critic"] == given


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"max_iterations": 3}, r"rsl_rl\.max_iterations: .* use train\.iterations$"),
        ({"logger": "wandb"}, r"rsl_rl\.logger: .* metrics\.jsonl"),
        ({"policy": {}}, r"rsl_rl\.policy: .* actor and critic$"),
        ({"actr": {}}, r"rsl_rl\.actr: there is no such key; did you mean actor\?$"),
        ({"num_steps_per_env": 0}, r"rsl_rl\.num_steps_per_env: .*greater than or equal to 1$"),
        ({"num_steps_per_env": True}, r"rsl_rl\.num_steps_per_env: .*integer"),
        ({"obs_groups": {"actor": "policy"}}, r"rsl_rl\.obs_groups\.actor: .*list"),
        ({"actor": [64]}, r"rsl_rl\.actor: .*dictionary"),
    ],
)
def test_settings_that_are_refused(section: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as refusal:
        read_settings(section)
    assert "\n" not in str(refusal.value)


def test_no_key_is_known_and_refused() -> None:
    assert not REFUSED.keys() & {item.name for item in dataclasses.fields(RslRlConfig)}
