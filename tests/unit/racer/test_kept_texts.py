"""A rank's job with a long text: read from its run, its digest checked, or refused in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from racer.rewards.reward_file import RewardFile, reward_file
from shared_store.volume.layout import Store
from shared_store.volume.texts import digest_of
from tests.support.refusals import refusal
from worker.learning.job import Job
from worker.settings.errors import UserError
from worker.settings.overrides import Refused

TEXT = "def reward_function(params):\n    return 1.0\n"
REFERENCE = {"file": "mine.py", "sha256": digest_of(TEXT)}


def environment(store: Path, kind: str) -> dict[str, str]:
    section: dict[str, Any] = {"task": "Racer", "config": {"track": "oval", "reward_function": REFERENCE}}
    spec = {"name": "line", kind: section}
    return {"MUSTER_STORE": str(store), "MUSTER_RUN": "line", "MUSTER_EPOCH": "1", "MUSTER_SPEC": json.dumps(spec)}


def test_a_rank_refuses_a_text_that_is_missing_or_altered(tmp_path: Path) -> None:
    path = Store(tmp_path).run("line").texts / REFERENCE["sha256"]
    begins = f"train.config.reward_function: mine.py (sha256 {REFERENCE['sha256']}): the text kept at {path} is "
    found = refusal(Job.from_env, environment(tmp_path, "train"), "train", error=UserError)
    assert found == f"{begins}missing; submit the job again with the file"
    path.parent.mkdir(parents=True)
    path.write_text(TEXT + "#")
    found = refusal(Job.from_env, environment(tmp_path, "train"), "train", error=UserError)
    assert found == f"{begins}altered: its content has another digest; submit the job again with the file"


def test_a_digest_alone_is_not_a_reward_function_that_could_be_run() -> None:
    with pytest.raises(
        Refused, match=r"mine\.py: its text, with sha256 .*, is kept beside a job; name the file itself"
    ):
        reward_file(RewardFile(**REFERENCE))
