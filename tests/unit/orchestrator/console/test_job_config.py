"""The code that a job holds, and what is different from another job's."""

from __future__ import annotations

from typing import Any

from orchestrator.console.job_config import code_of, differences

CODE = "def reward_function(params):\n    speed = params['speed']\n    return speed\n"


def racer(text: str) -> dict[str, Any]:
    return {
        "name": "fast",
        "train": {"task": "Racer", "config": {"reward_function": {"file": "mine.py", "text": text}}},
    }


def test_the_files_that_a_job_holds_are_its_code() -> None:
    assert code_of(racer(CODE)) == [("mine.py", CODE)]
    assert code_of({"name": "a", "command": ["true"], "environment": {"file": "x"}}) == []


def test_of_two_texts_the_lines_that_differ_are_shown_of_long_ones_from_their_beginning() -> None:
    changed = CODE.replace("return speed", "return 2 * speed") + "# faster\n"
    assert differences(racer(CODE), racer(changed)) == [
        ("train.config.reward_function.text", "3:     return speed", "3:     return 2 * speed\n4: # faster")
    ]
    assert differences({"seed": 1, "name": "a"}, {"seed": 2}) == [("seed", "1", "2"), ("name", "a", "")]
    ((_, was, now),) = differences(racer("a\n" * 2000), racer("b\n" * 2000))
    assert was.startswith("a\na\n") and was.endswith(" …") and now.startswith("b\nb\n") and len(now) < 310
