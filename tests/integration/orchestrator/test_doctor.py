"""``muster doctor``: what is there, what is missing, and what to do."""

from __future__ import annotations

import json
from pathlib import Path

from tests.conftest import Serving, call_muster


def test_all_requirements_are_installed(tmp_path: Path) -> None:
    done = call_muster("doctor", "--worker", "--engine", "local", home=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    for said in ("torch 2.", "a durable write takes", "muster serve starts one", "1 host, "):
        assert said in done.stdout


def test_a_controller_is_found(shared_server: Serving) -> None:
    found = json.loads(shared_server.muster("doctor", "--json").stdout)
    [controller] = [each for each in found if each["what"] == "controller"]
    assert (controller["state"], controller["said"]) == ("ok", f"{shared_server.url}, engines local")


def test_missing_parts_are_reported_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    bad = call_muster(
        *("doctor", "--store", str(tmp_path / "file" / "store"), "--engine", "docker", "--engine", "nothing"),
        home=tmp_path,
        DOCKER_HOST="unix:///nowhere.sock",
        MUSTER_URL="http://127.0.0.1:9",
    )
    assert bad.returncode == 1 and "Traceback" not in bad.stderr
    lines = [line for line in bad.stdout.splitlines() if line.startswith("BAD")]
    assert len(lines) == 4
    for said in (
        "file/store: Not a directory",
        "set DOCKER_HOST",
        "there is no engine 'nothing'",
        "http://127.0.0.1:9",
    ):
        assert any(said in line for line in lines), said
