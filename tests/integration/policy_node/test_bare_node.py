"""What pip makes of ``policy_node/`` alone: a node without torch and without the rest of Muster."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import venv
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import REPOSITORY
from tests.support.policy_node import write_bundle
from tests.unit.policy_node.walker import JOINTS, contract, term

HEAVY = ("torch", "warp", "newton", "worker", "shared_store", "orchestrator", "pydantic")
LARGEST = 300
"""Megabytes of an installation; 216 were measured, of which onnxruntime is 80, numpy 71 and Zenoh 33."""


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The executables of a new environment with the node and what it needs."""
    folder = tmp_path_factory.mktemp("bare") / "environment"
    venv.create(folder, with_pip=True)
    install = [folder / "bin" / "python", "-m", "pip", "install", "-q", "-c", REPOSITORY / "constraints.txt"]
    command = [*map(str, install), str(REPOSITORY / "policy_node")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    if done.returncode and "Could not find a version" in done.stderr:
        pytest.skip("no package index can be reached here: the bare policy node was NOT tested")
    assert done.returncode == 0, done.stderr
    return folder / "bin"


def test_the_node_runs_bare_and_is_small(bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    speed = term("joint_velocity", 0, 2, **JOINTS)
    bundle = write_bundle(tmp_path / "bundle", contract(speed), np.array([[1.0], [0.0]]))
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    command = [str(bare / "muster-policy"), str(bundle)]
    checked = subprocess.run([*command, "--check"], env=env, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert checked.returncode == 0 and "self-test passed" in checked.stdout, checked.stderr
    alone = ["--connect", "tcp/127.0.0.1:9", "--duration", "0.5"]
    ran = subprocess.run([*command, *alone], env=env, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 0 and "ended: 0 steps at 50 Hz" in ran.stdout, ran.stderr
    code = (
        "import sys, json, pkgutil, importlib, muster_policy\n"
        "for each in pkgutil.iter_modules(muster_policy.__path__): importlib.import_module('muster_policy.' + each.name)\n"
        "print(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})))"
    )
    loaded = subprocess.run([str(bare / "python"), "-c", code], env=env, cwd=tmp_path, capture_output=True, text=True)
    assert not set(json.loads(loaded.stdout)) & set(HEAVY), loaded.stdout
    packages = next((bare.parent / "lib").glob("python*/site-packages"))
    sizes = {
        each.name: sum(file.stat().st_size for file in each.rglob("*") if file.is_file())
        for each in packages.iterdir()
        if each.is_dir() and each.name.partition("-")[0] not in ("pip", "setuptools")
    }
    total = sum(sizes.values()) / 1e6
    with capsys.disabled():
        largest = sorted(sizes.items(), key=lambda entry: -entry[1])[:6]
        parts = ", ".join(f"{name} {size / 1e6:.0f}" for name, size in largest)
        print(f"\nthe bare policy node: {total:.0f} MB ({parts})", file=sys.stderr)
    assert total < LARGEST
