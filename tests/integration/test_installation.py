"""What pip makes of this repository without extras."""

from __future__ import annotations

import os
import subprocess
import venv
from pathlib import Path

from tests.conftest import REPOSITORY, wait_for


def test_a_bare_installation_gives_a_working_controller_without_torch(tmp_path: Path) -> None:
    venv.create(tmp_path / "bare", with_pip=True)
    python = str(tmp_path / "bare" / "bin" / "python")
    install = [python, "-m", "pip", "install", "-q", "-c", str(REPOSITORY / "constraints.txt"), str(REPOSITORY)]
    subprocess.run(install, check=True, capture_output=True, timeout=300)
    missing = "from importlib.util import find_spec; exit(any(map(find_spec, ('torch', 'warp', 'newton'))))"
    subprocess.run([python, "-c", missing], check=True)
    spec = tmp_path / "job.yaml"
    spec.write_text(
        "name: bare\nnodes: 2\nresources: {cpus: 0.1, memory: 16MiB}\ncommand: [python, -c, 'print(6 * 7)']\n"
    )
    env = {**os.environ, "MUSTER_HOME": str(tmp_path / "home")}
    command = [str(tmp_path / "bare" / "bin" / "muster"), "run", str(spec)]
    done = subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and "42" in done.stdout, done.stdout + done.stderr
    wait_for(lambda: not (tmp_path / "home" / "controller.json").exists(), 5, "the embedded controller's end")
