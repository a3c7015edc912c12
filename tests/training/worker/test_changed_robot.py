"""A policy was trained, and then a mass in its robot's file is changed: each command says so in one line, which says how to go on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import worker.tasks.library.cartpole
from shared_store.volume import models
from shared_store.volume.bundles import REPORT, read_contract
from shared_store.volume.checkpoints import list_checkpoints
from shared_store.volume.files import read_json
from shared_store.volume.layout import Run, Store
from tests.support.worker.changing_task import TASK, Changing
from tests.support.worker.clones import make_clone
from tests.support.worker.in_process import call_worker
from tests.support.worker.ranks import placement, training
from tests.support.worker.runs import runner, train
from worker import export, repeat_incident
from worker.settings.errors import TrainingError, UserError
from worker.telemetry.live_view import PolicyView

CHANGE = (
    "robot: mass [kg] 1.1 became 1.3; body pole: mass 0.1 became 0.3; "
    "body pole: inertia 0.0092944 0 0 0 0.0092944 0 0 0 7.919e-05 became 0.027883 0 0 0 0.027883 0 0 0 0.00023757"
)
OTHER = f"was trained on another robot than the file gives now: {CHANGE}"
ACCEPT = "; to go on all the same, add --accept-changed-robot (accept_changed_robot: true in a job's section)"


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "cart.xml"
    path.write_text(Path(worker.tasks.library.cartpole.__file__).with_name("cartpole.xml").read_text())
    monkeypatch.setattr(Changing, "file", path, raising=False)
    return path


@pytest.fixture
def trained(file: Path, tmp_path: Path) -> Run:
    """A run of one iteration, after which the pole became heavier."""
    train(job(tmp_path), task=Changing)
    change(file)
    return Store(tmp_path).run("run")


def job(store: Path, **options: Any) -> dict[str, str]:
    return training(store, **{"iterations": 1, "worlds": 16, "config": {"nan_limit": 10.0}, "task": TASK, **options})


def change(file: Path) -> None:
    text = file.read_text()
    assert text.count('mass="0.1"') == 1
    file.write_text(text.replace('mass="0.1"', 'mass="0.3"'))


def test_a_view_of_the_policy_needs_its_consent(trained: Run, capsys: pytest.CaptureFixture[str]) -> None:
    name = list_checkpoints(trained)[-1].name
    with pytest.raises(UserError) as refused:
        PolicyView(trained, {"checkpoint": None, "accept_changed_robot": False}, 1, 1, [])
    assert str(refused.value) == f"checkpoint {name} {OTHER}{ACCEPT}"
    PolicyView(trained, {"checkpoint": None, "accept_changed_robot": True}, 1, 1, [])
    assert f"warning: checkpoint {name} {OTHER}\n" in capsys.readouterr().out


def test_what_follows_from_an_accepted_robot_does_not_refuse_the_policy(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(job(tmp_path), task=Changing)
    file.write_text(file.read_text().replace('gear="10"', 'gear="8"'))
    PolicyView(Store(tmp_path).run("run"), {"checkpoint": None, "accept_changed_robot": True}, 1, 1, [])
    printed = capsys.readouterr().out
    assert "actuator slider: gear 10 became 8" in printed and "action 0: slider scale 10.0 became 8.0" in printed


def test_a_model_keeps_the_robot_of_its_training_and_says_that_it_changed(trained: Run, tmp_path: Path) -> None:
    (checkpoint,) = list_checkpoints(trained)
    for accepted in (False, True):
        section = {"run": "run", "episodes": 2, "worlds": 2, "accept_changed_robot": accepted}
        spec = json.dumps({"name": "bundle", "export": section})
        done = call_worker(export.main, {**job(tmp_path), **placement(), "MUSTER_SPEC": spec})
        assert (done.returncode == 0) == accepted, done.stdout + done.stderr
        assert f"checkpoint {checkpoint.name} {OTHER}" in (done.stdout if accepted else done.stderr)
    bundle = trained.exports / checkpoint.name
    assert read_contract(bundle).robots[0].elements["body pole"]["mass"] == 0.1
    assert (read_json(bundle / REPORT) or {})["changed_robot"] == f"checkpoint {checkpoint.name} {OTHER}"
    model = models.register(Store(tmp_path), "cart", trained, checkpoint, {})
    assert model.facts()["changed_robot"] == f"checkpoint {checkpoint.name} {OTHER}"


def test_a_clone_says_that_its_weights_are_of_another_robot(
    trained: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_clone(tmp_path, "clone", "run")
    capsys.readouterr()
    runner(job(tmp_path, run="clone"), task=Changing).close()
    warning = f"warning: the weights were learnt on another robot than the file gives now: {CHANGE}\n"
    assert capsys.readouterr().out.count(warning) == 1


def test_a_repeated_incident_says_that_it_happened_to_another_robot(file: Path, tmp_path: Path) -> None:
    with pytest.raises(TrainingError):
        train(job(tmp_path, iterations=3, config={"nan_limit": 0.0}), task=Changing)
    (incident,) = Store(tmp_path).run("run").incidents.iterdir()
    warning = f"warning: it happened to another robot than the file gives now: {CHANGE}; restore the file\n"
    assert "warning" not in call_worker(repeat_incident.main, {}, str(incident)).stdout
    change(file)
    again = call_worker(repeat_incident.main, {}, str(incident))
    assert again.returncode in (0, 1) and again.stdout.startswith(warning), again.stdout + again.stderr
