"""``python -m worker.telemetry.live_view``: show a training as it runs, a checkpoint's policy or a recording in Rerun's web viewer.

``muster view`` starts it. Rerun runs in this process and in its child; a rank never imports it.
"""

from __future__ import annotations

import argparse
import getpass
import os
import signal
import socket
import sys
import time
import webbrowser
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import closing
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from shared_store.contract.error_text import counted
from shared_store.volume.layout import Run
from shared_store.volume.log_view import LogView
from shared_store.volume.logs import LogLine
from shared_store.volume.metrics import history_of
from worker.settings.accepted_changes import CHANGED_ROBOTS
from worker.settings.errors import UserError
from worker.telemetry.live_recording import source_of
from worker.telemetry.page import ViewerPage, need_rerun
from worker.telemetry.progress import Activity, loading
from worker.telemetry.rows import Layout, Rows
from worker.telemetry.tap_request import PATIENCE, TapRequest

if TYPE_CHECKING:
    from worker.telemetry.rows import Segment
    from worker.telemetry.screen import Screen
    from worker.telemetry.stage import Stage

HZ = 20.0
"""Frames a second, at most."""
_POLL_SECONDS = 0.5
"""Between two polls of metrics and log."""
_LINES = 200
"""Lines of the log from before the view began."""
Start = Callable[[], ViewerPage]
"""Starts the page and prints its address."""


class WorldsView:
    """Worlds that are shown as they step.

    Args:
        title: Of the view.
        stage: Of the worlds.
        layout: Of their rows.
        stop: Filled when the view is to end.
    """

    def __init__(self, title: str, stage: Stage, layout: Layout, stop: list[int]) -> None:
        self._title, self._stage, self._layout, self._stop = title, stage, layout, stop
        self._iteration: int | None = None
        """Of the training, where there is one."""
        self.frames = 0

    def _screen(self, page: ViewerPage) -> Screen:
        from worker.telemetry.screen import Appearance, Screen

        stage, layout = self._stage, self._layout
        cameras = tuple(name for name, *_ in layout.images)
        look = Appearance(tuple(stage.links), stage.meshes(), stage.places(), layout.terms, cameras)
        return Screen(page.server, self._title, look, live=True)

    def _draw(self, screen: Screen, rows: Rows, number: int) -> None:
        """Show the newest of some rows, control step ``number``."""
        from worker.telemetry.screen import ShownSteps

        poses = self._stage.pose(rows.coordinates[-1])[None]
        images = {camera: {0: seen} for camera, seen in rows.pictures(-1).items()}
        now, rewards = np.array([time.time_ns()]), rows.terms[-1:].mean(1)
        screen.show(ShownSteps(now, np.array([number]), poses, rewards, self._iteration, images))
        self.frames += 1


class TrainingView(WorldsView):
    """A training of this machine: the newest state of its main rank's first worlds.

    Args:
        run: The run.
        job: Whose log is shown.
        worlds: How many are shown, at most.
        stop: Filled when the view is to end.
        activity: Which shows what takes long.
    """

    def __init__(self, run: Run, job: str, worlds: int, stop: list[int], activity: Activity) -> None:
        instead = f"see its newest checkpoint: muster view {run.name}"
        self._request = TapRequest(run, worlds, instead, stop, activity, newest=True)
        segment, stage, _ = self._request.open(PATIENCE)
        super().__init__(f"training {run.name}", stage, segment.layout, stop)
        self._segment: Segment | None = segment
        self._run, self._log, self._iteration = run, LogView.of(run, job), 0

    def show(self, start: Start) -> None:
        """Until the user ends it. Raises UserError where the viewer's server ends, or the training goes on elsewhere."""
        try:
            with start() as page, closing(self._screen(page)) as screen:
                screen.log(map(_line, deque(self._log.drain(), maxlen=_LINES)))
                polled = 0.0
                while not self._stop:
                    started = time.monotonic()
                    page.check()
                    if (rows := self._newest(screen)) is not None:
                        self._draw(screen, rows, rows.first + len(rows))
                    if started - polled > _POLL_SECONDS:
                        polled = started
                        self._update(screen)
                    time.sleep(max(0.0, 1 / HZ - (time.monotonic() - started)))
        finally:
            self._request.withdraw()

    def _newest(self, screen: Screen) -> Rows | None:
        """The newest control step, if it is a new one. Where the training has ended, request its next attempt."""
        if self._segment is None:
            self._segment = self._request.response()
            if self._segment is not None:
                self._report(screen, "the training goes on")
            return None
        ended = self._segment.closed or self._request.is_orphaned
        rows = self._segment.newest()
        if rows is None:
            if ended:
                self._report(
                    screen,
                    "the training stopped; the view goes on with its next attempt on this machine; Ctrl-C ends it",
                )
                self._segment = None
                self._request.send()
            return None
        worlds = self._stage.worlds
        if rows.layout.worlds < worlds or rows.layout.coordinates != self._stage.model.joint_coord_count // worlds:
            raise UserError("the training went on with other worlds; start the view again")
        return rows.of_worlds(worlds)

    def _update(self, screen: Screen) -> None:
        """Show what is new of metrics and log. A volume that is not reachable for a while does not end the view."""
        assert self._iteration is not None
        try:
            screen.log(map(_line, self._log.poll()))
            history = history_of(self._run)
            newest = (history.last() or {}).get("iteration", 0)
            # an attempt that resumed went back to its checkpoint
            records = history.after(self._iteration if newest >= self._iteration else newest - 1)
        except OSError:
            return
        known = [each for each in records if each.get("reward") is not None and each.get("time") is not None]
        times = np.array([1e9 * each["time"] for each in known]).astype(np.int64)
        screen.curve("mean", [each["reward"] for each in known], times, [each["iteration"] for each in known])
        # one may have come since the newest was read
        self._iteration = records[-1]["iteration"] if records else newest

    def _report(self, screen: Screen, text: str) -> None:
        print(text, flush=True)
        screen.log([(time.time_ns(), "muster", text)])


class PolicyView(WorldsView):
    """A checkpoint's policy on fresh worlds of this machine's CPU, in real time.

    Args:
        run: The run.
        section: As of :meth:`Rollout.of`: ``checkpoint``, ``accept_changed_robot``.
        worlds: How many worlds.
        episodes: Of each world; None: until the user ends it.
        stop: Filled when the view is to end.
    """

    def __init__(
        self, run: Run, section: Mapping[str, Any], worlds: int, episodes: int | None, stop: list[int]
    ) -> None:
        import torch

        from worker.telemetry.rollout import Rollout

        torch.set_num_threads(1)  # a few worlds: more threads would wait for each other
        self._rollout = rollout = Rollout.of(run, section, worlds, device="cpu")
        title = f"policy {run.name} {rollout.checkpoint.name}"
        super().__init__(title, rollout.stage(), Layout.of(rollout.task, worlds, 1), stop)
        self._episodes = sys.maxsize if episodes is None else episodes
        self._sums = np.zeros((worlds, 2))
        """Return and steps of each running episode."""
        self._ended = np.zeros(worlds, int)

    def show(self, start: Start) -> None:
        """Until each world has ended its episodes, or the user ends it."""
        rate = self._rollout.config.control_hz
        every = max(1, int(np.ceil(rate / HZ)))
        with start() as page, closing(self._screen(page)) as screen:
            self._introduce(screen)
            started, slow = 0.0, False
            for number, rows in enumerate(self._rollout.steps(sys.maxsize)):
                started = started or time.monotonic()
                if number % every == 0:
                    page.check()
                    self._draw(screen, rows, number)
                self._count(screen, rows)
                if self._stop or (self._ended >= self._episodes).all():
                    break
                ahead = (number + 1) / rate - (time.monotonic() - started)
                if ahead < -1.0 and not slow:
                    slow = True
                    print("note: this machine simulates slower than real time", flush=True)
                time.sleep(max(0.0, ahead))

    def _introduce(self, screen: Screen) -> None:
        """Show what is known of the policy."""
        run, worlds = self._rollout.run, counted(self._stage.worlds, "world")
        text = f"checkpoint {self._rollout.checkpoint.name} of run {run.name}: {worlds}, seed {self._rollout.seed}"
        screen.log([(time.time_ns(), "muster", text)])
        known = [each for each in history_of(run).after() if each.get("reward") is not None]
        # days ago, perhaps: on the timeline of iterations alone
        screen.curve("mean", [each["reward"] for each in known], None, [each["iteration"] for each in known])

    def _count(self, screen: Screen, rows: Rows) -> None:
        """Report the ends of episodes."""
        self._sums += np.stack([rows.rewards.sum(0), np.full(len(self._sums), len(rows))], 1)
        now = time.time_ns()
        for world in np.flatnonzero(rows.mark("done")[-1]):
            total, steps = self._sums[world]
            text = rows.end_of_episode(-1, int(world), self._ended[world], total, int(steps))
            screen.log([(now, "muster", text)])
            screen.curve("episodes", [total], np.array([now]), [])
            self._sums[world], self._ended[world] = 0.0, self._ended[world] + 1


def show_file(path: Path, start: Callable[[Path | None], ViewerPage], stop: list[int], activity: Activity) -> None:
    """Show a recording until the user ends it. Raises UserError where it can't be read."""
    if path.suffix == ".rrd":
        with start(_checked(path)) as page:
            _wait(page, stop)
        return
    from worker.telemetry.replay import Replay
    from worker.telemetry.screen import Screen

    replay = Replay(path)
    activity.say(f"reading {path.name} …")
    with start(None) as page, closing(Screen(page.server, path.name, replay.look, live=False)) as screen:
        for part in replay.parts():
            page.check()
            screen.show(part)
            if stop:
                return
        if replay.losses:
            print(f"note: {path.name} is {replay.losses}; the rest is shown", flush=True)
        if replay.cut:
            print(f"note: {path.name} was cut short; it is shown up to control step {replay.count}", flush=True)
        worlds = counted(len(replay.look.places), "world")
        print(f"shown: {counted(replay.count, 'control step')} of {worlds}; Ctrl-C ends the view", flush=True)
        _wait(page, stop)


def _checked(path: Path) -> Path:
    """An .rrd file. Raises UserError where it is none."""
    try:
        with path.open("rb") as file:
            begins = file.read(3)
    except OSError as error:
        raise UserError(f"{path}: it can't be read ({error.strerror or error})") from error
    if begins != b"RRF":
        raise UserError(f"{path}: it does not begin as an .rrd file does")
    return path


def _wait(page: ViewerPage, stop: list[int]) -> None:
    while not stop:
        page.check()
        time.sleep(0.1)


def _line(line: LogLine) -> tuple[int, str, str]:
    """Time [ns], node or rank, text."""
    when = datetime.fromisoformat(line.time)
    return int(when.timestamp() * 1e6) * 1000, source_of(line), line.text


def main() -> int:
    """Read the arguments; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m worker.telemetry.live_view")
    what = parser.add_mutually_exclusive_group(required=True)
    for name in ("--training", "--policy", "--file"):
        what.add_argument(name, type=Path)
    parser.add_argument("--job", default="")
    parser.add_argument("--checkpoint")
    parser.add_argument("--accept-changed-robot", action="store_true")
    parser.add_argument("--worlds", type=int, default=4)
    parser.add_argument("--episodes", type=int)
    parser.add_argument("--port", type=int)
    parser.add_argument("--memory", default="256MB")
    parser.add_argument("--browser", action="store_true")
    parser.add_argument("--framed-by", action="append", default=[])
    options = parser.parse_args()
    stop: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stop.append(number))
    try:
        with Activity() as activity:
            need_rerun()
            _show(options, stop, activity)
            return 0
    except UserError as error:
        print(f"muster: {error}", file=sys.stderr, flush=True)
        return 1


def _show(options: argparse.Namespace, stop: list[int], activity: Activity) -> None:
    def start(file: Path | None = None) -> ViewerPage:
        page = ViewerPage(options.port, options.memory, file, options.framed_by)
        activity.end()
        print(f"the view is at {page.url}", flush=True)
        if "SSH_CONNECTION" in os.environ:
            port = page.url.rpartition(":")[2]
            host = f"{getpass.getuser()}@{socket.gethostname()}"
            print(f"on your own machine, for a browser there: ssh -N -L {port}:127.0.0.1:{port} {host}", flush=True)
        if options.browser:
            webbrowser.open(page.url)
        return page

    if options.file:
        show_file(options.file, start, stop, activity)
        return
    view: TrainingView | PolicyView
    if options.training:
        view = TrainingView(Run(options.training), options.job, options.worlds, stop, activity)
        os.nice(10)  # where processors are short, frames are fewer, and the training goes on
    else:
        activity.say(loading(Run(options.policy), options.worlds))
        CHANGED_ROBOTS.set(options.accept_changed_robot)
        section = {"checkpoint": options.checkpoint, "accept_changed_robot": options.accept_changed_robot}
        view = PolicyView(Run(options.policy), section, options.worlds, options.episodes, stop)
    view.show(start)
    print(f"viewed: {counted(view.frames, 'frame')}", flush=True)


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # Rerun's threads would wait for a server that may be gone
