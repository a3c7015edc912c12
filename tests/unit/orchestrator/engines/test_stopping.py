"""Stops of gangs whose backend answers late, with a refusal, or never."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from orchestrator.engines.api import EngineError, Handle, NotYet, Transient
from orchestrator.engines.toolkit.stopping import stop_within

HANDLE = Handle("any", "job/1/1", 1, {"slurm": "7"})


def stop(seconds: float, step: Callable[[], str]) -> None:
    stop_within(seconds, step, engine="fake", gang="job/1/1", pause=0.001)


def test_a_stop_goes_on_until_nothing_is_left_whether_the_backend_answers_or_not() -> None:
    answers = iter(["two nodes run", NotYet("no route"), "one node runs", "", "not asked for"])

    def step() -> str:
        answer = next(answers)
        if isinstance(answer, NotYet):
            raise answer
        return str(answer)

    stop(60.0, step)
    assert next(answers) == "not asked for"


def refused() -> str:
    raise EngineError("not authorized")


def test_a_stop_that_is_never_answered_ends_with_the_last_answer_and_a_refused_one_at_once() -> None:
    with pytest.raises(EngineError, match=r"^not authorized$"):
        stop(60.0, refused)

    def step() -> str:
        raise NotYet("the daemon is away")

    for last, words in ((step, "the daemon is away"), (lambda: "one node runs", "one node runs")):
        with pytest.raises(Transient) as told:
            stop(0.02, last)
        assert str(told.value) == f"the fake engine has not ended gang job/1/1 within 0.02 s; last answer: {words}"


def test_a_slurm_that_never_answers_ends_the_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    from orchestrator.engines.slurm import engine as slurm

    def away(*_: str, **__: Any) -> str:
        raise slurm.Unreachable("slurmctld does not answer (connection refused); see `scontrol ping`")

    monkeypatch.setattr("orchestrator.engines.slurm.commands.call", lambda *_, **__: "")
    engine = slurm.SlurmEngine()
    monkeypatch.setattr("orchestrator.engines.slurm.commands.call", away)
    monkeypatch.setattr(slurm, "call", away)
    monkeypatch.setattr(slurm, "_KILLING", 0.05)
    with pytest.raises(Transient, match=r"^the slurm engine has not ended gang job/1/1 .*: slurmctld does not answer"):
        engine.stop(HANDLE, 0.0)


def test_a_ray_driver_that_never_answers_ends_the_stop(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from orchestrator.engines.ray import engine as ray
    from orchestrator.engines.ray.folder import Folder

    engine = object.__new__(ray.RayEngine)
    engine.home = tmp_path
    folder = Folder.of(tmp_path, "job")
    folder.make()
    folder.plan("job/1/1").write_text("{}")
    monkeypatch.setattr(Folder, "send", lambda *_: True)
    monkeypatch.setattr(ray, "_ENDING", 0.05)
    with pytest.raises(Transient, match=r"^the ray engine has not ended gang .*: its driver has said nothing yet$"):
        engine.stop(HANDLE, 0.0)
