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
from contextlib import ExitStack
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
from worker.telemetry.page import ViewerPage, need_rerun
from worker.telemetry.progress import Activity, loading
from worker.telemetry.rows import Rows

if TYPE_CHECKING:
    from worker.telemetry.screen import Appearance, Screen
    from worker.telemetry.segment import Segment
    from worker.telemetry.stage import Stage

HZ = 20.0
"""Frames a second, at most."""
_LOOK_SECONDS = 0.5
"""Between two looks at metrics and log."""
_LINES = 200
"""Lines of the log from before the view began."""
Shown = Callable[[], ViewerPage]
"""Starts the page and says where it is."""


class TrainingView:
    """A training of this machine: the newest state of its main rank's first worlds.

    Args:
        run: The run.
        job: Whose log is shown.
        worlds: How many are wanted.
        stop: Filled when the view is to end.
        activity: Which tells what takes long.
    """

    def __init__(self, run: Run, job: str, worlds: int, stop: list[int], activity: Activity) -> None:
        from worker.telemetry.live_recording import stage_of
        from worker.telemetry.tap_request import PATIENCE, Asking

        self._run, self._stop = run, stop
        instead = f"see its newest checkpoint: muster view {run.name}"
        self._asking = Asking(run, worlds, instead, newest=True)
        self._segment: Segment | None = self._asking.attach(PATIENCE, stop, activity)
        try:
            activity.say(loading(run, self._asking.worlds))
            if self._asking.worlds < worlds:
                print(f"note: the training has {counted(self._asking.worlds, 'world')} on its main rank", flush=True)
            if self._asking.note:
                print(f"note: {self._asking.note}", flush=True)
            self._stage, _ = stage_of(run, self._asking.worlds)
        except BaseException:
            self._asking.withdraw()
            raise
        self._log = LogView.of(run, job)
        self._iteration = 0
        self.frames = 0

    def show(self, start: Shown) -> None:
        """Until the user ends it. Raises UserError where the viewer's server ends, or the training goes on elsewhere."""
        try:
            with start() as page, ExitStack() as closing:
                screen: Screen | None = None
                looked = 0.0
                while not self._stop:
                    began = time.monotonic()
                    page.check()
                    rows = self._newest(screen)
                    if rows is not None:
                        poses = self._stage.pose(rows.coordinates[-1])[None]
                        if screen is None:
                            screen = self._open(page, rows, poses[0])
                            closing.callback(screen.close)
                        now, steps = np.array([time.time_ns()]), np.array([rows.first + len(rows)])
                        screen.frames(now, steps, poses, rows.terms[-1:].mean(1), self._iteration)
                        for camera, seen in rows.pictures(-1).items():
                            screen.pictures(camera, now, steps, [seen], self._iteration)
                        self.frames += 1
                    if screen is not None and began - looked > _LOOK_SECONDS:
                        looked = began
                        self._tell(screen)
                    time.sleep(max(0.0, 1 / HZ - (time.monotonic() - began)))
        finally:
            self._asking.withdraw()

    def _newest(self, screen: Screen | None) -> Rows | None:
        """The newest control step, if it is a new one. Where the training has ended, ask for its next attempt."""
        if self._segment is None:
            self._segment = self._asking.answer()
            if self._segment is not None:
                self._say(screen, "the training goes on")
            return None
        over = self._segment.closed or self._asking.is_answered_by_nobody
        rows = self._segment.newest()
        if over and rows is None:
            self._say(
                screen, "the training stopped; the view goes on with its next attempt on this machine; Ctrl-C ends it"
            )
            self._segment = None
            self._asking.ask()
        if rows is None:
            return None
        worlds = self._stage.worlds
        if rows.layout.worlds < worlds or rows.layout.coordinates != self._stage.model.joint_coord_count // worlds:
            raise UserError("the training went on with other worlds; start the view again")
        return rows.of_worlds(worlds)

    def _open(self, page: ViewerPage, rows: Rows, poses: np.ndarray) -> Screen:
        from worker.telemetry.screen import Screen

        screen = Screen(page.server, f"training {self._run.name}", look_of(self._stage, rows), poses, live=True)
        screen.say(map(_line, deque(self._log.drain(), maxlen=_LINES)))
        return screen

    def _tell(self, screen: Screen) -> None:
        """The news of metrics and log. A volume that is away for a while does not end the view."""
        try:
            screen.say(map(_line, self._log.poll()))
            history = history_of(self._run)
            newest = (history.last() or {}).get("iteration", 0)
            # an attempt that resumed went back to its checkpoint
            records = history.after(self._iteration if newest >= self._iteration else newest - 1)
        except OSError:
            return
        known = [each for each in records if each.get("reward") is not None and each.get("time") is not None]
        times = np.array([1e9 * each["time"] for each in known]).astype(np.int64)
        screen.curve("mean", [each["reward"] for each in known], times, [each["iteration"] for each in known])
        self._iteration = (
            records[-1]["iteration"] if records else newest
        )  # one may have come since the look at the newest

    def _say(self, screen: Screen | None, text: str) -> None:
        print(text, flush=True)
        if screen is not None:
            screen.say([(time.time_ns(), "muster", text)])


class PolicyView:
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
        self._rollout = Rollout.of(run, section, worlds, device="cpu")
        self._stage, self._episodes, self._stop = self._rollout.stage(), episodes, stop
        self._sums = np.zeros((worlds, 2))
        self._ended = np.zeros(worlds, int)
        self.frames = 0

    def show(self, start: Shown) -> None:
        """Until each world has ended its episodes, or the user ends it."""
        rate = self._rollout.config.control_hz
        every = max(1, int(np.ceil(rate / HZ)))
        with start() as page, ExitStack() as closing:
            screen: Screen | None = None
            began, late = time.monotonic(), False
            for number, rows in enumerate(self._rollout.steps(sys.maxsize)):
                if screen is None:
                    began = time.monotonic()
                    screen = self._open(page, rows)
                    closing.callback(screen.close)
                if number % every == 0:
                    page.check()
                    poses = self._stage.pose(rows.coordinates[-1])[None]
                    now, steps = np.array([time.time_ns()]), np.array([number])
                    screen.frames(now, steps, poses, rows.terms[-1:].mean(1))
                    for camera, seen in rows.pictures(-1).items():
                        screen.pictures(camera, now, steps, [seen])
                    self.frames += 1
                self._count(screen, rows)
                if self._stop or (self._episodes is not None and (self._ended >= self._episodes).all()):
                    break
                ahead = (number + 1) / rate - (time.monotonic() - began)
                if ahead < -1.0 and not late:
                    late = True
                    print("note: this machine simulates slower than real time", flush=True)
                time.sleep(max(0.0, ahead))

    def _open(self, page: ViewerPage, rows: Rows) -> Screen:
        from worker.telemetry.screen import Screen

        checkpoint, run = self._rollout.checkpoint, self._rollout.run
        title = f"policy {run.name} {checkpoint.name}"
        screen = Screen(
            page.server, title, look_of(self._stage, rows), self._stage.pose(rows.coordinates[-1]), live=True
        )
        text = f"checkpoint {checkpoint.name} of run {run.name}: {counted(self._stage.worlds, 'world')}, seed {self._rollout.seed}"
        screen.say([(time.time_ns(), "muster", text)])
        known = [each for each in history_of(run).after() if each.get("reward") is not None]
        # days ago, perhaps: on the timeline of iterations alone
        screen.curve("mean", [each["reward"] for each in known], None, [each["iteration"] for each in known])
        return screen

    def _count(self, screen: Screen, rows: Rows) -> None:
        """Tell the ends of episodes."""
        self._sums += np.stack([rows.rewards.sum(0), np.full(len(self._sums), len(rows))], 1)
        now = time.time_ns()
        for world in np.flatnonzero(rows.mark("done")[-1]):
            total, steps = self._sums[world]
            text = f"world {world}: episode {self._ended[world]} ended by {rows.cause(-1, int(world))} after {counted(int(steps), 'step')}, return {total:.4g}"
            screen.say([(now, "muster", text)])
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
    with start(None) as page, ExitStack() as closing:
        screen: Screen | None = None
        for part in replay.parts():
            page.check()
            if screen is None:
                screen = Screen(page.server, path.name, replay.look, part.poses[0], live=False)
                closing.callback(screen.close)
            screen.frames(part.times, part.steps, part.poses, part.rewards)
            for camera in replay.look.cameras:
                screen.pictures(camera, *part.pictures(camera))
            screen.say(part.said)
            screen.curve("episodes", [value for _, value in part.returns], np.array([at for at, _ in part.returns]), [])
            if stop:
                return
        if replay.losses:
            print(f"note: {path.name} is {replay.losses}; the rest is shown", flush=True)
        if replay.cut:
            print(f"note: {path.name} was cut short; it is shown up to control step {replay.count}", flush=True)
        print(
            f"shown: {counted(replay.count, 'control step')} of {counted(len(replay.look.places), 'world')}; Ctrl-C ends the view",
            flush=True,
        )
        _wait(page, stop)


def look_of(stage: Stage, rows: Rows) -> Appearance:
    """A stage's worlds, beside each other."""
    from worker.telemetry.screen import Appearance

    cameras = tuple(name for name, *_ in rows.layout.images)
    return Appearance(tuple(stage.links), stage.meshes(), stage.places(), rows.layout.terms, cameras)


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
    """Time [ns], who says it, text."""
    when = datetime.fromisoformat(line.time)
    who = f"node {line.node}" if line.rank is None else f"rank {line.rank}"
    return int(when.timestamp() * 1e6) * 1000, who, line.text


def _start(given: argparse.Namespace, activity: Activity) -> Callable[[Path | None], ViewerPage]:
    def start(file: Path | None) -> ViewerPage:
        page = ViewerPage(given.port, given.memory, file, given.framed_by)
        activity.end()
        print(f"the view is at {page.url}", flush=True)
        if "SSH_CONNECTION" in os.environ:
            port = page.url.rpartition(":")[2]
            there = f"{getpass.getuser()}@{socket.gethostname()}"
            print(f"on your own machine, for a browser there: ssh -N -L {port}:127.0.0.1:{port} {there}", flush=True)
        if given.browser:
            webbrowser.open(page.url)
        return page

    return start


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
    given = parser.parse_args()
    stop: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stop.append(number))
    try:
        with Activity() as activity:
            need_rerun()
            return _show(given, _start(given, activity), stop, activity)
    except UserError as error:
        print(f"muster: {error}", file=sys.stderr, flush=True)
        return 1


def _show(
    given: argparse.Namespace, start: Callable[[Path | None], ViewerPage], stop: list[int], activity: Activity
) -> int:
    if given.file:
        show_file(given.file, start, stop, activity)
        return 0
    source: Any
    if given.training:
        source = TrainingView(Run(given.training), given.job, given.worlds, stop, activity)
        os.nice(10)  # where processors are short, frames are fewer, and the training goes on
    else:
        activity.say(loading(Run(given.policy), given.worlds))
        CHANGED_ROBOTS.set(given.accept_changed_robot)
        section = {"checkpoint": given.checkpoint, "accept_changed_robot": given.accept_changed_robot}
        source = PolicyView(Run(given.policy), section, given.worlds, given.episodes, stop)
    source.show(lambda: start(None))
    print(f"viewed: {counted(source.frames, 'frame')}", flush=True)
    return 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # Rerun's threads would wait for a server that may be gone
