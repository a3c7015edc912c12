"""``muster export`` and ``muster models`` as a user meets them: on a policy that was trained."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from shared_store.volume.bundles import verify
from tests.conftest import Serving, call_muster
from tests.support.worker.trained import run_in


@pytest.fixture(scope="module")
def home(trained_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    home = shutil.copytree(trained_home, tmp_path_factory.mktemp("copy") / "home")
    with Serving(home):
        yield home


def test_a_run_is_exported_registered_compared_and_verified(home: Path, tmp_path: Path) -> None:
    run = run_in(home)
    output = tmp_path / "bundle"
    options = ("-o", str(output), "--worlds", "4", "--episodes", "4")
    done = call_muster("export", f"{run.name}@2", *options, home=home)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "of the bundle" in done.stdout and f"bundle:      {output} (9 files" in done.stdout, done.stdout
    assert verify(output)["iteration"] == 2
    assert json.loads((output / "contract.json").read_text()) == json.loads(run.contract.read_text())
    report = json.loads((output / "report.json").read_text())
    assert report["judged"]["episodes"] == 4 and report["parity"]["observations"]["rollout"] >= 1000
    assert (output / "robot" / "cartpole.xml").exists()
    for version, options in ((1, ()), (2, ("--again",))):
        done = call_muster("models", "register", f"{run.name}@2", "--name", "cart", *options, home=home)
        assert f"as cart@{version}" in done.stdout, done.stdout + done.stderr
    twice = call_muster("models", "register", f"{run.name}@2", "--name", "cart", home=home)
    line = "muster: the same checkpoint is cart@2 already; --again registers it once more\n"
    assert (twice.returncode, twice.stdout, twice.stderr) == (1, "", line)
    unexported = call_muster("models", "register", f"{run.name}@1", "--name", "cart", home=home)
    assert f"is not exported; export it first: muster export {run.name}@1" in unexported.stderr
    listed = json.loads(call_muster("models", "list", "--json", home=home).stdout)
    assert [(each["name"], each["version"], each["run"]) for each in listed] == [("cart", 2, run.name)]
    shown = call_muster("models", "show", "cart@1", home=home).stdout
    assert "of versions 1, 2" in shown and f"run {run.name}, checkpoint 00000002-e1" in shown
    same = call_muster("models", "diff", "cart", home=home)
    assert same.returncode == 0 and "have the same contract, settings, versions and weights" in same.stdout, (
        same.stdout + same.stderr
    )
    assert call_muster("models", "verify", "cart", home=home).returncode == 0
    onnx = home / "store" / "models" / "cart" / "2" / "bundle" / "policy.onnx"
    os.chmod(onnx, 0o644)
    onnx.write_bytes(onnx.read_bytes()[:-1] + b"\0")
    damaged = call_muster("models", "verify", "cart", home=home)
    assert damaged.returncode == 1 and "policy.onnx was altered" in damaged.stdout


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (("export", "RUN@7"), "run RUN has no checkpoint of iteration 7; available: 1, 2"),
        (("export", "RUNX"), "did you mean RUN?"),
        (("export", "RUN", "-o", "/"), "-o /: it exists and is not a bundle; name a new directory"),
        (("models", "register", "RUN@7", "--name", "x"), "run RUN has no checkpoint of iteration 7; available: 1, 2"),
        (("models", "register", "RUN", "--name", "../x"), "model name '../x': use letters, digits"),
        (("models", "show", "nothing"), "model nothing does not exist"),
        (("models", "verify", "cart@0"), "cart@0: expected a version after @, such as cart@1"),
    ],
)
def test_wrong_use_is_one_line(home: Path, arguments: tuple[str, ...], output: str) -> None:
    run = run_in(home)
    done = call_muster(*(each.replace("RUN", run.name) for each in arguments), home=home)
    (line,) = done.stderr.strip().splitlines()
    assert done.returncode != 0 and output.replace("RUN", run.name) in line, done.stdout + done.stderr
