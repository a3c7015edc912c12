"""`muster resume --json` where it is the controller itself."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

SPEC = "name: resumed\nresources: {cpus: 1, memory: 256MiB}\ncommand: [sh, -c, 'echo a line of the job; exit 3']\n"


def test_standard_output_is_json_alone_without_a_controller(tmp_path: Path) -> None:
    (tmp_path / "job.yaml").write_text(SPEC)
    known = {key: value for key, value in os.environ.items() if key not in ("MUSTER_URL", "MUSTER_TOKEN")}
    environment = {**known, "MUSTER_HOME": str(tmp_path / "home")}
    muster = [str(Path(sys.executable).with_name("muster"))]
    options = {"env": environment, "cwd": tmp_path, "capture_output": True, "text": True}
    first = subprocess.run([*muster, "run", "job.yaml"], **options)
    assert "a line of the job" in first.stdout and "FAILED" in first.stdout, first.stderr
    run = next(line.split()[-1] for line in first.stdout.splitlines() if line.strip().startswith("run:"))
    done = subprocess.run([*muster, "resume", run, "--json"], **options)
    assert json.loads(done.stdout)["run"] == run
    assert done.returncode != 0 and "FAILED" in done.stderr
