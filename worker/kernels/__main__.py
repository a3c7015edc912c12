"""``python -m worker.kernels``: make the package of compiled kernels.

make kernels-pack                              all tasks, for all GPUs: build/kernels/muster_kernels-….whl
make kernels-pack TASKS="Ant Humanoid" TARGETS=sm90
python -m worker.kernels list                  on a GPU: write down what each task loads there
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from worker.kernels import making
from worker.settings.errors import UserError


def main() -> int:
    """Returns the exit code: 0, or 1 after lines that say what is wrong."""
    parser = argparse.ArgumentParser(
        "python -m worker.kernels", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for name, words in (
        ("pack", "compile the kernels of tasks and make a wheel; needs no GPU"),
        ("compile", "compile the kernels of one task"),
        ("list", "write down what tasks load on this machine's GPU"),
    ):
        command = commands.add_parser(name, help=words)
        command.add_argument("tasks", nargs="*", help="names of tasks; by default all that are installed")
        if name != "list":
            command.add_argument(
                "--targets",
                nargs="+",
                choices=making.TARGETS,
                default=making.TARGETS,
                metavar="TARGET",
                help=", ".join(making.TARGETS),
            )
            command.add_argument("--build", type=Path, default=Path("build/kernels"), help="directory of what is made")
    arguments = parser.parse_args()
    try:
        return _run(arguments)
    except (UserError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _run(arguments: argparse.Namespace) -> int:
    from worker.tasks import task_names

    tasks = arguments.tasks or list(task_names())
    if arguments.command == "compile":
        (task,) = tasks
        count, problems = making.compile_task(task, arguments.targets, arguments.build)
        print("\n".join([*problems, f"{task}: {count} kernels"]), flush=True)
        return 1 if problems else 0
    if arguments.command == "list":
        return _list(tasks)
    started = time.monotonic()
    wheel = making.make(tasks, arguments.targets, arguments.build)
    print(f"{wheel}: {wheel.stat().st_size / 1e6:.1f} MB, {time.monotonic() - started:.0f} s")
    return 0


def _list(tasks: list[str]) -> int:
    """One task in this process, many in one each."""
    if len(tasks) == 1:
        making.keep({tasks[0]: making.loaded_on_gpu(tasks[0])})
        return 0
    import subprocess

    return max(subprocess.run([sys.executable, "-m", "worker.kernels", "list", task]).returncode for task in tasks)


if __name__ == "__main__":
    sys.exit(main())
