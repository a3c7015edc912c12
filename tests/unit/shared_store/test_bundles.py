"""Bundles: what was sealed is found as it was, or the file that differs is named."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shared_store import bundles
from shared_store.bundles import DamagedBundle


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


def test_a_sealed_bundle_verifies_and_lists_every_other_file(bundle: Path) -> None:
    manifest = bundles.verify(bundle)
    assert sorted(manifest["files"]) == ["policy.onnx", "robot/arm.xml"]
    digest = hashlib.sha256(b"weights").hexdigest()
    assert manifest["files"]["policy.onnx"] == {"size": 7, "sha256": digest}
    assert (manifest["run"], manifest["score"]) == ("ant", 1.5)


@pytest.mark.parametrize(
    ("damage", "said"),
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
def test_a_difference_is_named_in_one_line(bundle: Path, damage: Callable[[Path], Any], said: str) -> None:
    damage(bundle)
    with pytest.raises(DamagedBundle, match=said) as caught:
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


def test_a_manifest_can_not_name_a_path_that_leads_elsewhere_or_be_of_a_newer_format(bundle: Path) -> None:
    path = bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps({**manifest, "files": {"../secret": {"size": 1, "sha256": "0"}}}))
    with pytest.raises(DamagedBundle, match=r"names '\.\./secret', which is no file of it"):
        bundles.verify(bundle)
    path.write_text(json.dumps({**manifest, "format": 2}))
    with pytest.raises(DamagedBundle, match="has format 2, this Muster reads up to 1; upgrade Muster"):
        bundles.verify(bundle)


def test_a_copy_is_atomic(bundle: Path, tmp_path: Path) -> None:
    bundles.copy(bundle, tmp_path / "out" / "copy")
    assert bundles.verify(tmp_path / "out" / "copy") == bundles.verify(bundle)
    with pytest.raises(FileExistsError):
        bundles.copy(bundle, tmp_path / "out" / "copy")
    flip(bundle / "policy.onnx", 0)
    with pytest.raises(DamagedBundle):
        bundles.copy(bundle, tmp_path / "out" / "second")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["copy"]
