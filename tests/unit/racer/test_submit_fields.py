"""The fields of the racer's wizard: code comes back as it was written."""

from __future__ import annotations

import pytest

from orchestrator.console.forms import Form
from orchestrator.console.submit_fields import document, filled, groups, written
from orchestrator.spec import strict_yaml

CODES = ("def f():\n    return 1\n", "# ½ 😀\n\n\n\tx = 'a: b'\n", "  indented\nless\n", "trailing \n\n", "one line")


@pytest.mark.parametrize("code", [*CODES, "#:\n- &a *b\n"])
def test_code_comes_out_of_the_yaml_as_it_was_written(code: str) -> None:
    name = "train.config.reward_function"
    form = Form({name: [code.replace("\n", "\r\n")], "train.config.track": ["a", "b"], "name": ["x"]})
    job, _ = strict_yaml.load(written(document("Racer", filled(form, groups("Racer", [])))))
    assert job["train"]["config"]["reward_function"]["text"].rstrip("\n") == code.rstrip("\n")
    assert job["train"]["config"]["track"] == ["a", "b"]
