"""Bundles, and the registry of models made of them: versions count up, never change, and show any damage."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shared_store.volume import bundles, models
from shared_store.volume.bundles import DamagedBundle, seal
from shared_store.volume.checkpoints import Checkpoint
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import Run, Store
from shared_store.volume.models import AlreadyRegistered, Model, ModelError
from tests.support.shared_store.at_once import at_once


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return made(tmp_path / "bundle")


def made(path: Path) -> Path:
    (path / "robot").mkdir(parents=True)
    (path / "policy.onnx").write_bytes(b"weights")
    (path / "robot" / "arm.xml").write_text("<mujoco/>")
    bundles.seal(path, {"run": "ant", "score": 1.5})
    return path


def flip(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(bytes(data))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: flip(path / "robot" / "arm.xml", 3), r"the content of robot/arm\.xml was altered"),
        (lambda path: (path / "policy.onnx").write_bytes(b"weight"), r"policy\.onnx has 6 bytes, 7 were written"),
        (lambda path: (path / "policy.onnx").unlink(), r"policy\.onnx is missing"),
        (lambda path: (path / "more.txt").write_text("x"), r"more\.txt was added; manifest\.json does not list it"),
        (lambda path: (path / ".hidden").write_text("x"), r"\.hidden was added"),
        (lambda path: os.symlink("/etc/passwd", path / "link"), r"link is not a regular file"),
        (lambda path: (path / "manifest.json").unlink(), r"manifest\.json is missing; is it a directory that"),
        (lambda path: (path / "manifest.json").write_text("{"), r"manifest\.json can't be read"),
    ],
)
def test_a_difference_is_named_in_one_line(bundle: Path, damage: Callable[[Path], Any], message: str) -> None:
    damage(bundle)
    with pytest.raises(DamagedBundle, match=message) as caught:
        bundles.verify(bundle)
    assert "\n" not in str(caught.value)


def test_every_changed_byte_of_the_manifest_itself_is_found(bundle: Path) -> None:
    path = bundle / "manifest.json"
    for place in range(path.stat().st_size):
        flip(path, place)
        with pytest.raises(DamagedBundle):
            bundles.verify(bundle)
        flip(path, place)
    bundles.verify(bundle)


def test_a_manifest_can_t_name_a_path_that_leads_elsewhere_or_be_of_a_newer_format(bundle: Path) -> None:
    path = bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps({**manifest, "files": {"../secret": {"size": 1, "sha256": "0"}}}))
    with pytest.raises(DamagedBundle, match=r"names '\.\./secret', which is not a file of it"):
        bundles.verify(bundle)
    path.write_text(json.dumps({**manifest, "format": 2}))
    with pytest.raises(DamagedBundle, match="has format 2, this Muster reads up to 1; upgrade Muster"):
        bundles.verify(bundle)


def test_a_copy_is_atomic(bundle: Path, tmp_path: Path) -> None:
    bundles.copy(bundle, tmp_path / "out" / "copy")
    assert bundles.verify(tmp_path / "out" / "copy") == bundles.verify(bundle)
    with pytest.raises(FileExistsError):
        bundles.copy(bundle, tmp_path / "out" / "copy")
    (tmp_path / "out" / "copy" / "old").touch()
    bundles.copy(bundle, tmp_path / "out" / "copy", overwrite=True)
    assert bundles.verify(tmp_path / "out" / "copy") == bundles.verify(bundle)
    flip(bundle / "policy.onnx", 0)
    with pytest.raises(DamagedBundle):
        bundles.copy(bundle, tmp_path / "out" / "second")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["copy"]


PARENT = {"run": "base", "checkpoint": "00000002-e1", "iteration": 2}
EVALUATED = {"mean_return": 800.0, "mean_length": 10.0, "max_length": 20, "episodes": 3, "time": 1.0}


def exported(store: Store, iteration: int = 4, **facts: Any) -> tuple[Run, Checkpoint]:
    """A run with a bundle of a checkpoint."""
    run = store.run("ant")
    name = f"{iteration:08d}-e1"
    run.create({"spec": {"name": "ant"}, "parent": PARENT, "created": 1.0})
    bundle = run.exports / name
    bundle.mkdir(parents=True)
    (bundle / "policy.onnx").write_bytes(b"weights")
    (bundle / "report.json").write_text(json.dumps({"judged": {"episodes": 16}}))
    seal(bundle, {"task": "Ant", "score": 812.3, "versions": {"muster": "0.1.0"}, "code": {"module": "ant"}, **facts})
    run.evaluations.mkdir(exist_ok=True)
    (run.evaluations / f"{name}.json").write_text(json.dumps(EVALUATED))
    return run, Checkpoint(run.checkpoints / name, iteration, 1)


def register(store: Store, name: str = "ant", **facts: Any) -> Model:
    run = store.run("ant")
    bundle = next(iter(sorted(run.exports.iterdir())))
    return models.register(store, name, run, Checkpoint(run.checkpoints / bundle.name, 4, 1), facts)


def test_a_model_holds_its_bundle_and_where_it_comes_from(store: Store) -> None:
    exported(store)
    model = register(store, queue="robots")
    assert (model.reference, model.path) == ("ant@1", store.path / "models" / "ant" / "1")
    model.verify()
    facts = model.facts()
    assert (facts["run"], facts["checkpoint"], facts["parent"]) == ("ant", "00000004-e1", PARENT)
    assert (facts["spec"], facts["task"], facts["queue"]) == ({"name": "ant"}, "Ant", "robots")
    assert (facts["made_with"], facts["code"]) == ({"muster": "0.1.0"}, {"module": "ant"})
    (evaluated,) = facts["evaluations"]
    assert evaluated["mean_return"] == 800.0 and evaluated["checkpoint"] == "00000004-e1"
    assert facts["judged"] == {"episodes": 16}
    assert (model.bundle / "policy.onnx").read_bytes() == b"weights"


def test_versions_count_up_and_existing_ones_stay(store: Store) -> None:
    exported(store)
    first = register(store)
    before = {path: path.read_bytes() for path in first.path.rglob("*") if path.is_file()}
    assert [register(store).version for _ in range(3)] == [2, 3, 4]
    assert {path: path.read_bytes() for path in first.path.rglob("*") if path.is_file()} == before
    assert [model.version for model in models.versions(store, "ant")] == [1, 2, 3, 4]
    assert models.find(store, "ant").version == 4 and models.find(store, "ant", 2).version == 2
    assert models.model_names(store) == ["ant"]
    assert all(os.stat(path).st_mode & 0o222 == 0 for path in before), "nothing of it may be written"


def test_a_registered_checkpoint_is_registered_again_only_on_request(store: Store) -> None:
    run, checkpoint = exported(store)
    first = models.register(store, "ant", run, checkpoint, {}, again=False)
    message = r"^the same checkpoint is ant@1 already; --again registers it once more$"
    with pytest.raises(AlreadyRegistered, match=message):
        models.register(store, "ant", run, checkpoint, {}, again=False)
    assert os.listdir(store.models / "ant") == ["1"], "nothing is made"
    assert models.register(store, "other", run, checkpoint, {}, again=False).reference == "other@1"
    assert models.register(store, "ant", run, checkpoint, {}, again=True).reference == "ant@2"
    shutil.rmtree(run.path)  # and another run of its name, whose checkpoint of that name is another one
    run, checkpoint = exported(store, checkpoint_files={"learner.pt": "other"})
    assert models.register(store, "ant", run, checkpoint, {}, again=False).reference == "ant@3"
    first.verify()


def register_five(path: str, number: str) -> list[int]:
    facts = {"registered_by": number}
    return [register(Store(path), "ant", **facts).version for _ in range(5)]


def test_processes_that_register_at_once_get_a_version_each(store: Store) -> None:
    exported(store)
    answers = at_once(register_five, [(str(store.path), number) for number in "0123"])
    values = {version: str(number) for number, versions in enumerate(answers) for version in versions}
    assert sorted(values) == list(range(1, 21)), "twenty versions, none of them twice"
    for model in models.versions(store, "ant"):
        model.verify()
        assert model.facts()["registered_by"] == values[model.version]
    assert sorted(os.listdir(store.models / "ant"), key=int) == [str(number) for number in range(1, 21)]


KILLED = """
import os, signal, sys
from shared_store.volume import bundles, models
from shared_store.volume.checkpoints import Checkpoint
from shared_store.volume.layout import Store
store = Store(sys.argv[1])
run = store.run("ant")
bundles.publish = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
models.register(store, sys.argv[2], run, Checkpoint(run.checkpoints / "00000004-e1", 4, 1), {}, sys.argv[3])
"""


def test_the_leftovers_of_a_killed_registration_are_deleted_by_its_controller_s_next_one(store: Store) -> None:
    run, checkpoint = exported(store)
    for name, registrar in (("bee", "a1"), ("ant", "b2")):
        subprocess.run([sys.executable, "-c", KILLED, str(store.path), name, registrar], timeout=60)
    hidden = [path.name for path in store.models.glob("*/.*")]
    assert sorted(name.split(".")[1] for name in hidden) == ["a1", "b2"]
    assert models.register(store, "ant", run, checkpoint, {}, "a1").reference == "ant@1"
    left = [path.name for path in store.models.glob("*/.*")]
    assert [name.split(".")[1] for name in left] == ["b2"], "another controller's may go on"
    models.find(store, "ant").verify()


def test_damage_of_a_model_is_found(store: Store) -> None:
    exported(store)
    model = register(store)
    for path in ("bundle/policy.onnx", "bundle/manifest.json", "model.json", "manifest.json"):
        content = (model.path / path).read_bytes()
        os.chmod(model.path / path, 0o644)
        (model.path / path).write_bytes(content[:-2] + bytes([content[-2] ^ 1]) + content[-1:])
        with pytest.raises(DamagedBundle):
            model.verify()
        (model.path / path).write_bytes(content)
        model.verify()
    (model.bundle / "notes.txt").write_text("added")
    with pytest.raises(DamagedBundle, match=r"bundle/notes\.txt was added"):
        model.verify()
    (model.bundle / "notes.txt").unlink()
    (model.path / "model.json").unlink()
    with pytest.raises(DamagedBundle, match=r"model\.json is missing"):
        model.verify()


def test_a_refused_registration_leaves_nothing_behind(store: Store) -> None:
    run, checkpoint = exported(store)
    other = Checkpoint(run.checkpoints / "00000008-e1", 8, 1)
    with pytest.raises(ModelError, match=r"is not exported; export it first: muster export ant@8$"):
        models.register(store, "ant", run, other, {})
    (run.exports / checkpoint.name / "policy.onnx").write_bytes(b"weightz")
    with pytest.raises(DamagedBundle, match=r"the content of policy\.onnx was altered"):
        models.register(store, "ant", run, checkpoint, {})
    assert models.model_names(store) == [] and os.listdir(store.models / "ant") == []
    with pytest.raises(ModelError, match=r"^model ant does not exist; no model is registered yet$"):
        models.find(store, "ant")


def test_links_in_the_place_of_a_model_or_a_bundle_are_not_followed(store: Store, tmp_path: Path) -> None:
    run, checkpoint = exported(store)
    store.models.mkdir()
    (tmp_path / "elsewhere").mkdir()
    os.symlink(tmp_path / "elsewhere", store.models / "ant")
    with pytest.raises(DamagedFile, match="a link"):
        register(store)
    assert not list((tmp_path / "elsewhere").iterdir())
    (store.models / "ant").unlink()
    os.rename(run.exports / checkpoint.name, tmp_path / "bundle")
    os.symlink(tmp_path / "bundle", run.exports / checkpoint.name)
    with pytest.raises(DamagedFile, match="a link"):
        register(store)
    assert models.model_names(store) == []
