"""``muster record``, ``render`` and ``view``: recordings, films, pictures and live views of policies."""

from __future__ import annotations

import os
import re
import shutil
import signal
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli import command_options as options
from orchestrator.cli.controllers import controller
from orchestrator.cli.outputs import check_output
from orchestrator.cli.progress import Activity
from orchestrator.cli.runs import chosen
from orchestrator.cli.submitting import submit_spec
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.client import Client, named
from orchestrator.domain.errors import ApiError, ServerError, UsageError
from orchestrator.engines.local.forks import prepared
from orchestrator.home import muster_home
from orchestrator.spec.model import Record, Render, Spec
from orchestrator.spec.sections import Resources, Retry
from shared_store.process.tether import start_tied

_FILES = (".mcap", ".partial", ".rrd")
_FILMS = """Examples:  muster render ant-1f2e3d4c -o gait.gif --seconds 6
muster render ant-1f2e3d4c@best -o gait.mp4 --worlds 1 --size 1280x720
muster render ant-1f2e3d4c@300 -o moments.png"""
_VIEWER = "worker.telemetry.live_view"


def register(app: typer.Typer) -> None:
    app.command(epilog="Example:  muster record ant-1f2e3d4c@best -o ant.mcap --worlds 4 --episodes 2")(record)
    app.command(epilog=_FILMS)(render)
    app.command(
        epilog="Examples:  muster view cartpole   muster view ant-1f2e3d4c@best --worlds 2   muster view ant.mcap --port 9100"
    )(view)


def record(
    source: options.SourceArgument = None,
    output: options.OutputOption = None,
    worlds: Annotated[int, typer.Option(min=1, max=16, help="Number of worlds.")] = 4,
    episodes: Annotated[int, typer.Option(min=1, help="Number of episodes of each world.")] = 2,
    overwrite: options.OverwriteOption = False,
    recover: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Repair a truncated .mcap.partial into a readable file; nothing is recorded."
        ),
    ] = None,
    accept_changed_robot: options.AcceptOption = False,
    store: options.StoreOption = None,
    cpus: options.CpusOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Record a policy in action as an MCAP file, for ROS 2's tools and viewers.

    Foxglove, Lichtblick, PlotJuggler and Rerun open it. For a RUN, a separate job runs a checkpoint's policy with its mean action in new
    worlds. For a JOB that is training on this machine, the main rank's worlds are recorded as they train.
    """
    if recover is not None:
        if source is not None or output is not None:
            raise UsageError("--recover: give only the truncated file; the recovered one is written beside it")
        raise typer.Exit(run_worker("worker.telemetry.live_recording", "--recover", str(recover)))
    if source is None:
        raise UsageError("give a run or a job, and -o FILE.mcap; or --recover FILE.mcap.partial")
    if output is None:
        raise UsageError(f"-o is missing: muster record {source} -o FILE.mcap")
    check_output(output, overwrite, ".mcap")
    with controller(store, cpus) as connect:
        client = connect()
        run, live = source_of(client, source)
        if live is not None:
            arguments = ("--worlds", str(worlds), "--episodes", str(episodes), "--output", str(output.absolute()))
            module = "worker.telemetry.live_recording"
            raise typer.Exit(run_worker(module, run["path"], "--job", live, *arguments, run=run["path"]))
        section = Record(
            run=run["run"],
            checkpoint=checkpoint_of(client, run, source),
            accept_changed_robot=accept_changed_robot,
            worlds=worlds,
            episodes=episodes,
        )
        _make(client, run, Spec(**_common(run, "record"), record=section), output, as_json)


def render(
    source: options.SourceArgument,
    output: options.OutputOption,
    worlds: Annotated[int, typer.Option(min=1, max=16, help="Number of worlds, side by side.")] = 4,
    seconds: Annotated[float, typer.Option(min=0.1, max=600, help="Simulated time.")] = 6.0,
    size: Annotated[str, typer.Option(metavar="WIDTHxHEIGHT", help="Size of a frame [px].")] = "640x360",
    overwrite: options.OverwriteOption = False,
    accept_changed_robot: options.AcceptOption = False,
    store: options.StoreOption = None,
    cpus: options.CpusOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Film a checkpoint's policy in action, or draw six moments of it.

    The file's ending decides: .mp4 and .gif are films, .png is a picture.
    """
    if source is None or output is None:
        raise UsageError("give a run, and -o FILE.gif (or .mp4, .png)")
    check_output(output, overwrite, ".gif", ".mp4", ".png")
    found = re.fullmatch(r"(\d{2,4})x(\d{2,4})", size)
    if not found:
        raise UsageError(f"--size {size}: expected WIDTHxHEIGHT, such as 640x360")
    with controller(store, cpus) as connect:
        client = connect()
        run, _ = source_of(client, source)
        values: dict[str, Any] = {"run": run["run"], "checkpoint": checkpoint_of(client, run, source), "worlds": worlds}
        values |= {"accept_changed_robot": accept_changed_robot, "format": output.suffix[1:]}
        values |= {"seconds": seconds, "width": int(found[1]), "height": int(found[2])}
        try:
            section = Render.model_validate(values)
        except ValueError:
            raise UsageError(f"--size {size}: each side is from 64 to 4096 pixels, and even for an .mp4") from None
        _make(client, run, Spec(**_common(run, "render"), render=section), output, as_json)


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
        str,
        typer.Option(
            metavar="SIZE", help="Memory for data of pages opened later, such as 1GB; beyond it the oldest data goes."
        ),
    ] = "256MB",
    accept_changed_robot: options.AcceptOption = False,
    store: options.StoreOption = None,
    cpus: options.CpusOption = None,
) -> None:
    """View a training, a checkpoint's policy or a recording in a browser.

    The page shows the worlds in 3-D, the curve of the return, the reward terms and the log. It is Rerun's web viewer, on this machine's
    loopback, and needs no internet access: pip install 'muster[viz]'.
    """
    if not re.fullmatch(r"[1-9][0-9]{0,5}(MB|GB)", memory):
        raise UsageError(f"--memory {memory}: expected a number with MB or GB, such as 256MB")
    arguments = ["--worlds", str(worlds), "--memory", memory]
    arguments += ["--port", str(port)] if port is not None else []
    arguments += ["--browser"] if (_has_display() if browser is None else browser) else []
    if source.endswith(_FILES) or os.sep in source:
        path = Path(source).absolute()
        if not path.is_file():
            raise UsageError(f"{source}: no such file")
        if path.suffix not in _FILES:
            raise UsageError(f"{source}: give a recording with the ending .mcap, .mcap.partial or .rrd")
        if episodes is not None:
            raise UsageError("--episodes: only the policy of a RUN takes it; a recording is shown whole")
        raise typer.Exit(run_worker(_VIEWER, "--file", str(path), *arguments))
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
            raise typer.Exit(run_worker(_VIEWER, "--training", path, "--job", live, *arguments, run=path))
        arguments += ["--checkpoint", str(checkpoint_of(client, run, source))]
        arguments += ["--episodes", str(episodes)] if episodes is not None else []
        arguments += ["--accept-changed-robot"] if accept_changed_robot else []
        raise typer.Exit(run_worker(_VIEWER, "--policy", path, *arguments, run=path))


def _has_display() -> bool:
    """Whether a user would see an opened browser."""
    has = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform == "darwin"
    return bool(has) and sys.stdout.isatty() and not os.environ.get("SSH_CONNECTION")


def source_of(client: Client, source: str) -> tuple[dict[str, Any], str | None]:
    """The run of a reference, and the job if that is training now. Raises ApiError, UsageError."""
    name = options.split_reference(source)[0]
    try:
        return client.get(f"/api/runs/{named(name)}"), None
    except ApiError as error:
        if error.status != 404:
            raise
        try:
            detail = client.get(f"/api/jobs/{named(name)}")
        except ApiError as other:
            raise (error if other.status == 404 else other) from None
    run: dict[str, Any] = detail["results"] or {}
    if detail["status"] in ("STARTING", "RUNNING") and detail["kind"] == "train" and "@" not in source:
        return run, detail["id"]
    if not run.get("checkpoints"):
        raise UsageError(f"job {name} is {detail['status']} and its run has no checkpoint yet")
    return run, None


def checkpoint_of(client: Client, run: dict[str, Any], source: str) -> int:
    """The iteration of the referenced checkpoint. Raises UsageError if it does not exist."""
    iteration: int = chosen(client, run["run"], options.split_reference(source)[1])["iteration"]
    return iteration


def _common(run: dict[str, Any], kind: str) -> dict[str, Any]:
    """The parts of a job's spec that come from the training: queue, image, environment."""
    spec = run.get("spec") or {}
    kept = {key: spec[key] for key in ("queue", "image", "environment") if spec.get(key)}
    trained = spec.get("resources") or {}
    resources = Resources(cpus=min(1.0, trained.get("cpus", 1.0)), memory=max(trained.get("memory", 2048), 2048))
    return {"name": f"{run['run'][:100]}-{kind}", "resources": resources, "retry": Retry(attempts=1), **kept}


def _make(client: Client, run: dict[str, Any], spec: Spec, output: Path, as_json: bool) -> None:
    """Run the job and bring its file to ``output``. Raises typer.Exit, ServerError."""
    job = submit_spec(client, spec, spec.name)["jobId"]
    with Activity() as activity:
        activity.wait(client, job)
        for line in client.logs(job, follow=True):
            if line["rank"] is None:
                continue
            if line["text"].startswith(("recorded: ", "rendered: ")):
                activity.end()
                echo(line["text"], err=as_json)
            elif line["text"].startswith(("loading ", "recording: ", "rendering: ", "compiling ")):
                activity.show(line["text"])
    detail = client.get(f"/api/jobs/{job}")
    if detail["status"] != "SUCCEEDED":
        raise ServerError(f"{spec.name} failed: {detail['statusReason']}")
    made = list((Path(run["path"]) / "recordings").glob(f"*-{job[:8]}{output.suffix}"))
    facts = {"run": run["run"], "jobId": job, "path": str(output) if made else None}
    if made:
        _move(made[0], output)
    if as_json:
        echo_json(facts)
    elif made:
        echo(f"written: {output}")
    else:
        place = f"{run['path']}/recordings"
        echo(f"made in the run's directory {place}, which can't be seen from this machine: *-{job[:8]}{output.suffix}")


def _move(made: Path, output: Path) -> None:
    """Move a file to another volume, where it appears whole. Raises ServerError."""
    hidden = output.with_name(f".{output.name}.{made.stem[-8:]}.tmp")
    try:
        shutil.copyfile(made, hidden)
        os.replace(hidden, output)
        made.unlink(missing_ok=True)
    except OSError as error:
        hidden.unlink(missing_ok=True)
        raise ServerError(f"-o {output}: it can't be written ({error.strerror or error}); it lies at {made}") from None


def run_worker(module: str, *arguments: str, run: str = "") -> int:
    """Run a part of the worker on this machine, since this package never imports it; returns its exit code.

    Ctrl-C and SIGTERM let it complete its file. However this process dies, it dies too.

    Args:
        module: Of the worker.
        arguments: Of its command line.
        run: Directory of a run, whose store may have the tracks that its configuration names.

    Raises:
        ServerError: The worker is not installed here.
    """
    if find_spec("newton") is None:
        raise ServerError("this needs the simulation on this machine: pip install 'muster[worker]'")
    store = {"MUSTER_STORE": str(Path(run).parents[1])} if run else {}
    ignored = [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else []  # nohup
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])  # until it can be passed on
    environment = {"WARP_CACHE_PATH": str(muster_home() / "kernels"), **os.environ, **store}  # as jobs have it
    started = None
    if server := prepared():
        with suppress(OSError):
            if "--file" in arguments:  # which needs no simulation
                server.close()
            else:
                started = server.become(module, arguments, environment)
    if started is None:
        started = start_tied([sys.executable, "-P", "-m", module, *arguments], ignored, env=environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends Ctrl-C to both
    signal.signal(signal.SIGTERM, lambda *_: started.send_signal(signal.SIGINT))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
    return started.wait()
