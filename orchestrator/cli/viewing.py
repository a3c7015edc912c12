"""``muster view``: view a running training, a checkpoint's policy or a recording in a browser."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Annotated

import typer

from orchestrator.cli.controllers import controller
from orchestrator.cli.options import AcceptOption, CpusOption, StoreOption
from orchestrator.cli.recordings import checkpoint_of, run_worker, source_of
from orchestrator.domain.errors import ServerError, UsageError

_FILES = (".mcap", ".partial", ".rrd")
_VIEWER = "worker.telemetry.live_view"


def register(app: typer.Typer) -> None:
    app.command(
        epilog="Examples:  muster view cartpole   muster view ant-1f2e3d4c@best --worlds 2   muster view ant.mcap --port 9100"
    )(view)


def view(
    source: Annotated[
        str,
        typer.Argument(
            metavar="JOB | RUN[@ITERATION|@best|@latest] | FILE",
            help="A training that runs on this machine; a checkpoint's policy; a recording (.mcap, .mcap.partial, .rrd).",
        ),
    ],
    worlds: Annotated[int, typer.Option(min=1, max=16, help="Number of worlds to show of a JOB or RUN.")] = 4,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="For a RUN: end after this many episodes of each world.")
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(
            min=1, max=65535, help="Port of the page and its stream; by default the first free one of 9090 to 9099."
        ),
    ] = None,
    browser: Annotated[
        bool | None,
        typer.Option("--browser/--no-browser", help="Open the page; by default only with a terminal and a display."),
    ] = None,
    memory: Annotated[
        str, typer.Option(help="Memory for data of pages opened later, such as 1GB; beyond it the oldest data goes.")
    ] = "256MB",
    accept_changed_robot: AcceptOption = False,
    store: StoreOption = None,
    cpus: CpusOption = None,
) -> None:
    """View a training, a checkpoint's policy or a recording in a browser.

    The page shows the worlds in 3-D, the curve of the return, the reward terms and the log. It is Rerun's web viewer, on this machine's
    loopback, and needs no internet access: pip install 'muster[viz]'.
    """
    if not re.fullmatch(r"[1-9][0-9]{0,5}(MB|GB)", memory):
        raise UsageError(f"--memory {memory}: expected a number with MB or GB, such as 256MB")
    options = ["--worlds", str(worlds), "--memory", memory]
    options += ["--port", str(port)] if port is not None else []
    options += ["--browser"] if (_has_display() if browser is None else browser) else []
    if source.endswith(_FILES) or os.sep in source:
        path = Path(source).absolute()
        if not path.is_file():
            raise UsageError(f"{source}: no such file")
        if path.suffix not in _FILES:
            raise UsageError(f"{source}: give a recording with the ending .mcap, .mcap.partial or .rrd")
        if episodes is not None:
            raise UsageError("--episodes: only the policy of a RUN takes it; a recording is shown whole")
        raise typer.Exit(run_worker(_VIEWER, "--file", str(path), *options))
    with controller(store, cpus) as connect:
        client = connect()
        run, live = source_of(client, source)
        path = run["path"]
        if not Path(path).is_dir():
            raise ServerError(
                f"run {run['run']} lies at {path}, which is not visible from this machine; run muster view on a machine with the store"
            )
        if live is not None:
            if episodes is not None:
                raise UsageError(
                    f"--episodes: {source} is training; to see its newest policy: muster view {run['run']}"
                )
            raise typer.Exit(run_worker(_VIEWER, "--training", path, "--job", live, *options, run=path))
        options += ["--checkpoint", str(checkpoint_of(client, run, source))]
        options += ["--episodes", str(episodes)] if episodes is not None else []
        options += ["--accept-changed-robot"] if accept_changed_robot else []
        raise typer.Exit(run_worker(_VIEWER, "--policy", path, *options, run=path))


def _has_display() -> bool:
    """Whether a user would see an opened browser."""
    has = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform == "darwin"
    return bool(has) and sys.stdout.isatty() and not os.environ.get("SSH_CONNECTION")
