"""`muster clone` through a real server: what it takes over, what it refuses before a job exists, and what it leaves in the store."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume.checkpoints import FORMAT, list_checkpoints
from shared_store.volume.initial_weights import NewRun, parent_checkpoint
from shared_store.volume.layout import Run, Store
from tests.conftest import Serving
from tests.support.orchestrator.jobs import refusal
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run
from tests.support.waiting import wait_for


@pytest.fixture(scope="module")
def store(full: Serving) -> Store:
    """It has a run with three checkpoints."""
    store = Store(full.home / "store")
    add_run(store, "taught")
    add_checkpoint(store, "taught", 3, b"three", score=5.0, score_error=0.5, score_episodes=120, reward=1.0)
    add_checkpoint(store, "taught", 6, b"six", score=9.25, score_error=0.25, score_episodes=110, reward=0.0)
    add_checkpoint(store, "taught", 9, b"nine", score=7.0, score_error=0.5, score_episodes=130, reward=99.0)
    return store


def clone(server: Serving, source: str, name: str, *options: str) -> dict[str, Any]:
    done = server.muster("clone", source, "--name", name, "--json", *options)
    assert done.returncode == 0, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def weights(run: Run) -> bytes:
    parent = parent_checkpoint(run)
    assert parent is not None
    return (parent.path / "learner.pt").read_bytes()


@pytest.mark.parametrize(
    ("reference", "iteration", "held"), [("taught", 9, b"nine"), ("taught@3", 3, b"three"), ("taught@best", 6, b"six")]
)
def test_a_named_checkpoint_is_cloned(full: Serving, store: Store, reference: str, iteration: int, held: bytes) -> None:
    name = f"of-{iteration}"
    answer = clone(full, reference, name)
    assert answer["run"] == name and answer["jobName"] == name and answer["parent"]["iteration"] == iteration
    assert weights(store.run(name)) == held
    description = store.run(name).description()
    assert description is not None and description["job"] == answer["jobId"]
    lineage = description["parent"]
    assert lineage["run"] == "taught" and lineage["checkpoint"] == f"{iteration:08d}-e1"
    assert lineage == full.client.get(f"/api/runs/{name}")["parent"] == answer["parent"]
    assert full.client.get("/api/runs/taught")["parent"] is None
    spec = full.detail(answer["jobId"])["spec"]
    assert (spec["name"], spec["train"]["ppo"]["hidden_sizes"]) == (name, [8])
    if reference == "taught@best":
        shown = " ".join(full.muster("show", name).stdout.split())
        assert "started from: taught@6 (checkpoint 00000006-e1, score 9.25 ± 0.25)" in shown


def test_a_waiting_clone_does_not_need_its_source_and_may_be_resumed(full: Serving, store: Store) -> None:
    add_run(store, "gone", {**SPEC, "name": "gone"})
    add_checkpoint(store, "gone", 5, b"kept")
    job = clone(full, "gone", "heir")["jobId"]
    shutil.rmtree(store.run("gone").path)
    assert weights(store.run("heir")) == b"kept"
    full.client.batch("TerminateJob", jobId=job, reason="test")
    full.wait(job)
    resumed = full.client.post("/api/runs/heir/resume", {})
    assert resumed["iteration"] == 0 and weights(store.run("heir")) == b"kept"


REFUSED = {
    "nobody": "run nobody does not exist",
    "taught@4": "run taught has no checkpoint of iteration 4; available: 3, 6, 9",
    "taught --name taught": "run taught exists already: give the clone another --name",
    "taught --name 'a b'": "clone of run taught: name: expected letters",
    "empty": "run empty has no checkpoint yet, so there are no weights to begin with",
    "script": "run script is a command job, and only a training has weights to begin with",
    "batch": "run batch was not started from a YAML spec",
    "unscored@best": "no checkpoint has a score yet, which is a mean over at least 100 episodes.*: 2",
    "old": "checkpoint 00000002-e1 is of an older Muster",
    "altered": r"checkpoint 00000004-e1: the content of learner\.pt was altered.*another \(2\)",
    "missing": r"checkpoint 00000002-e1: learner\.pt is missing; choose another \(there is none\)",
    "newer": f"has format {FORMAT + 1}, this Muster reads up to {FORMAT}; upgrade Muster",
    "taught --set train.ppo.hidden_sizes=[9]": r"train\.ppo\.hidden_sizes \[8\], which can't become \[9\]",
    "taught --set train.ppo.activation=relu": r"train\.ppo\.activation 'elu', which can't become 'relu'",
    "taught --set train.algorithm=sac --set train.ppo={}": (
        r"has weights of algorithm ppo, which sac can't read.*train\.algorithm=ppo, or with a module:Class"
    ),
    "taught --set train.ppo.lr=1": r"clone of run taught: train\.ppo\.lr: unknown key",
    "taught --set name=y": "--set name=y: a clone has the name that --name gives it",
    "taught --nodes 9": "clone x: ",
    "taught --queue nowhere": "Job queue nowhere does not exist; available: default",
    # before the weights are read: those of iteration 4 are damaged
    "altered --queue nowhere": "Job queue nowhere does not exist; available: default",
}
"""What is refused of a clone ``x``, and how."""
CONFLICTS = ("taught --name taught", "old", "altered", "missing", "newer")


@pytest.fixture(scope="module")
def damaged(store: Store) -> None:
    """Runs that can't be cloned."""
    add_run(store, "empty")
    add_run(store, "script", {"name": "script", "command": ["true"]})
    add_run(store, "batch", None)
    for other in ("unscored", "old", "altered", "missing", "newer"):
        add_run(store, other)
        add_checkpoint(store, other, 2, **({"algorithm": None} if other == "old" else {}))
    (add_checkpoint(store, "altered", 4).path / "learner.pt").write_bytes(b"WEIGHTS")
    (list_checkpoints(store.run("missing"))[0].path / "learner.pt").unlink()
    manifest = list_checkpoints(store.run("newer"))[0].path / "manifest.json"
    manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "format": FORMAT + 1}))


@pytest.mark.parametrize("line", REFUSED)
def test_what_cannot_be_is_refused_by_name(full: Serving, damaged: None, line: str) -> None:
    words = shlex.split(line)
    words += [] if "--name" in words else ["--name", "x"]
    assert re.search(REFUSED[line], refusal(full, "clone", *words, code=1 if line in CONFLICTS else 2))


def test_a_run_of_a_name_that_a_waiting_job_has_is_refused(full: Serving, store: Store) -> None:
    clone(full, "taught", "waiting")
    shutil.rmtree(full.home / "store" / "runs" / "waiting")
    assert "run waiting is being written by job waiting" in refusal(full, "clone", "taught", "--name", "waiting")


def test_leftovers_of_a_crashed_clone_are_removed(full: Serving, store: Store) -> None:
    clone(full, "taught", "before-crash")
    (owner,) = {path.name.removesuffix(".json") for path in (store.path / "controllers").glob("*.json")}
    leftover, foreign = (store.path / "runs" / f".{each}.0123456789ab.clone" for each in (owner, "another"))
    for path in (leftover, foreign):
        (path / "parent").mkdir(parents=True)
    clone(full, "taught", "after-crash")
    assert not leftover.exists() and foreign.exists(), "only the controller that made it knows that nobody works on it"


def test_a_run_that_a_crash_left_without_its_job_says_what_to_do(full: Serving, store: Store) -> None:
    making = NewRun(store, "crashed", "taught", list_checkpoints(store.run("taught"))[0])
    making.copy()
    making.publish("orphan", {"run": "orphan", "created": 1, "spec": {**SPEC, "name": "orphan"}, "queue": "default"})
    making.close()
    output = refusal(full, "clone", "taught", "--name", "orphan", code=1)
    assert "run orphan exists already" in output
    assert "no job has begun it: `muster resume orphan` does, or delete " in output
    assert full.client.post("/api/runs/orphan/resume", {})["iteration"] == 0
    assert "no job has begun it" not in refusal(full, "clone", "taught", "--name", "orphan", code=1)


# -- the teacher ------------------------------------------------------------------------------------------------------


def student(tmp_path: Path, teacher: str) -> str:
    algorithm = {"algorithm": {"class_name": "Distillation"}, "teacher_checkpoint": teacher}
    train = {"task": "Cartpole", "worlds": 4, "iterations": 2, "algorithm": "rsl_rl", "rsl_rl": algorithm}
    path = tmp_path / "student.yaml"
    path.write_text(json.dumps({"name": "student", "resources": SPEC["resources"], "train": train}))
    return str(path)


@pytest.mark.parametrize(
    ("teacher", "output"),
    [
        ("nobody@3", "run nobody does not exist"),
        ("taught@4", "run taught has no checkpoint of iteration 4; available: 3, 6, 9"),
        ("idle", "run idle has no checkpoint yet; train it first"),
        ("taught@best", "expected RUN or RUN@ITERATION, found 'taught@best'"),
        ("../taught", "expected RUN or RUN@ITERATION"),
    ],
)
def test_a_missing_teacher_is_refused(full: Serving, store: Store, tmp_path: Path, teacher: str, output: str) -> None:
    add_run(store, "idle")
    assert f"train.rsl_rl.teacher_checkpoint: {output}" in refusal(full, "submit", student(tmp_path, teacher))


def held(run: Run, teacher: str) -> list[bytes]:
    return [(each.path / "learner.pt").read_bytes() for each in list_checkpoints(run.teacher(teacher))]


def test_a_submitted_job_keeps_its_teachers_weights_for_good(full: Serving, store: Store, tmp_path: Path) -> None:
    add_run(store, "mentor")
    for iteration in (2, 4):
        add_checkpoint(store, "mentor", iteration, f"weights {iteration}".encode())
    add_checkpoint(store, "mentor", 6)
    hidden = {path.name for path in (store.path / "runs").glob(".*.clone")}
    references = {"mentor": b"weights", "mentor@4": b"weights 4", "mentor@00000002-e1": b"weights 2"}
    for reference, expected in references.items():
        done = full.muster("submit", student(tmp_path, reference), "--json")
        assert done.returncode == 0, done.stderr
        job = json.loads(done.stdout)["jobId"]
        run = store.run(full.detail(job)["run"])
        assert held(run, "mentor") == [expected] and run.is_missing()
    shutil.rmtree(store.run("mentor").path)
    assert held(run, "mentor") == [b"weights 2"]
    assert "run mentor does not exist" in refusal(full, "submit", student(tmp_path, "mentor@4"))
    wait_for(
        lambda: {path.name for path in (store.path / "runs").glob(".*.clone")} == hidden, 10, "no copy that is left"
    )


def test_a_teacher_with_damaged_weights_is_refused_at_submission(full: Serving, store: Store, tmp_path: Path) -> None:
    add_run(store, "broken")
    (add_checkpoint(store, "broken", 2).path / "learner.pt").write_bytes(b"WEIGHTS")
    output = refusal(full, "submit", student(tmp_path, "broken"))
    assert "train.rsl_rl.teacher_checkpoint: run broken: checkpoint 00000002-e1: the content of learner.pt" in output


def test_a_student_with_the_weights_needs_no_teacher_and_its_clone_may_have_another(
    full: Serving, store: Store, tmp_path: Path
) -> None:
    add_run(store, "pupil", json.loads(Path(student(tmp_path, "deleted@3")).read_text()))
    settings = {"teacher_checkpoint": "deleted@3"}
    add_checkpoint(store, "pupil", 1, b"pupil", algorithm="rsl_rl", settings=settings)
    assert full.client.post("/api/runs/pupil/resume", {})["iteration"] == 1
    job = clone(full, "pupil", "heir-of-pupil")["jobId"]
    assert weights(store.run("heir-of-pupil")) == b"pupil"
    full.client.batch("TerminateJob", jobId=job, reason="test")
    full.wait(job)
    assert full.client.post("/api/runs/heir-of-pupil/resume", {})["iteration"] == 0
    teacher = "train.rsl_rl.teacher_checkpoint=taught@"
    clone(full, "pupil", "of-another", "--set", f"{teacher}3")
    assert held(store.run("of-another"), "taught") == [b"three"] and weights(store.run("of-another")) == b"pupil"
    output = refusal(full, "clone", "pupil", "--name", "of-none", "--set", f"{teacher}4")
    assert "run taught has no checkpoint of iteration 4" in output
