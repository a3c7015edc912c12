"""Functions of the product that one control step and one submission enter: what a reader of each needs.

    python -m benchmarks.reading

A control step: from one ``act`` of the algorithm to the next, in the loop that trains Ant on the CPU, where nothing is captured. A
submission: ``muster submit job_specs/cartpole.yaml`` and the server, from the request until the job runs; what the server's loop enters in
two idle seconds is part of it, since a reader can't tell. Functions that Warp compiles are not counted.
"""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("orchestrator", "shared_store", "worker", "racer", "policy_node")
entered: dict[CodeType, None] = {}
"""Code of the functions entered since the last :func:`clear`, in order."""


def watch() -> None:
    """Note each function that any thread of this process enters from now on."""

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            entered[frame.f_code] = None

    threading.setprofile(note)
    sys.setprofile(note)


def functions() -> set[str]:
    """``file:line`` of each function of the product that was entered; lambdas, comprehensions and modules are not counted."""
    found = set()
    for code in list(entered):
        path = Path(code.co_filename)
        if code.co_name[0] != "<" and path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in PACKAGES:
            found.add(f"{path.relative_to(ROOT)}:{code.co_firstlineno}")
    return found


def all_functions(*packages: str) -> int:
    """How many functions the packages have."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    files = [file for package in packages for file in (ROOT / package).rglob("*.py") if "build" not in file.parts]
    return sum(isinstance(node, kinds) for file in files for node in ast.walk(ast.parse(file.read_text())))


def control_step() -> set[str]:
    """Of one control step of Ant and PPO."""
    from benchmarks.training import build
    from worker.simulation.capture import CapturedStep

    def record(step: Any) -> None:
        step._function()

    # a recording is made by the function that it replays: enter it, as a GPU's capture of the rollout does
    CapturedStep.launch = record  # type: ignore[assignment, method-assign]
    with tempfile.TemporaryDirectory() as store:
        loop: Any = build("Ant", 4, Path(store) / "store")
        loop._iterate()
        acts = 0

        def note(frame: FrameType, event: str, _: Any) -> None:
            nonlocal acts
            if event == "call":
                acts += frame.f_code.co_name == "act" and "worker/learning/" in frame.f_code.co_filename
                if acts == 1:
                    entered[frame.f_code] = None

        sys.setprofile(note)
        loop._iterate()
        sys.setprofile(None)
        return functions()


def traced(target: str) -> None:
    """Be the command with this process' arguments; on SIGUSR1 forget what was entered, at the end write it to ``target``."""
    signal.signal(signal.SIGUSR1, lambda *_: entered.clear())
    signal.signal(signal.SIGUSR2, lambda *_: Path(target).write_text("\n".join(sorted(functions()))))
    from orchestrator.cli import main

    watch()
    try:
        main()
    finally:
        sys.setprofile(None)
        if not Path(target).exists():
            Path(target).write_text("\n".join(sorted(functions())))


def submission() -> set[str]:
    """Of one submission, in the command and in the server."""
    with tempfile.TemporaryDirectory() as scratch:
        home = {**os.environ, "MUSTER_HOME": f"{scratch}/home"}

        def start(name: str, *arguments: str, **options: Any) -> subprocess.Popen[str]:
            command = [sys.executable, "-c", f"from benchmarks.reading import traced; traced({f'{scratch}/{name}'!r})"]
            return subprocess.Popen([*command, *arguments], env=home, cwd=ROOT, text=True, **options)

        server = start("server", "serve", "--port", "0", stdout=subprocess.PIPE)
        assert server.stdout is not None
        home["MUSTER_URL"] = server.stdout.readline().split()[2]
        time.sleep(2)
        server.send_signal(signal.SIGUSR1)
        start("command", "submit", str(ROOT / "job_specs/cartpole.yaml")).wait()
        muster = [sys.executable, "-c", "from orchestrator.cli import main; main()"]
        listed = [*muster, "list"]
        for _ in range(100):
            if "RUNNING" in subprocess.run(listed, env=home, cwd=ROOT, capture_output=True, text=True).stdout:
                break
            time.sleep(0.5)
        server.send_signal(signal.SIGUSR2)
        while not Path(scratch, "server").exists():
            time.sleep(0.1)
        time.sleep(1)  # until it is written
        found = [line for name in ("server", "command") for line in Path(scratch, name).read_text().splitlines()]
        subprocess.run([*muster, "stop", "cartpole"], env=home, cwd=ROOT)
        time.sleep(3)
        server.terminate()
        server.wait()
        return set(found)


def main() -> None:
    """Print the table."""
    print("| | functions entered | of | share |\n|---|--:|--:|--:|")
    for name, found, packages in (
        ("one control step", control_step(), ("worker",)),
        ("one submission", submission(), ("orchestrator", "shared_store")),
    ):
        count = len([line for line in found if line.split("/")[0] in packages])
        total = all_functions(*packages)
        print(f"| {name} | {count} | {total:,} | {count / total:.1%} |")
        if "--list" in sys.argv:
            print("\n".join(sorted(found)))


if __name__ == "__main__":
    main()
