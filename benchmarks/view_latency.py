"""Latency of ``muster view`` on a running training: from the end of a control step to Rerun's page in Chromium, on the CPU.

    python -m benchmarks.view_latency [--task Ant] [--worlds 64] [--seconds 30] [--out DIRECTORY]

A process trains; this one is ``muster view``, whose page is open in Chromium without a display. After each displayed frame a word of
twelve random letters follows in the stream, whose arrival a script in the page detects. All times are of one machine's clock. Writes
``view.md``.
"""

from __future__ import annotations

import argparse
import random
import signal
import string
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import rerun as rr

from benchmarks.load import Watch, add_option, machine, reported
from benchmarks.training import build
from shared_store.volume.layout import Run
from tests.support.browser import empty_page
from worker.telemetry import screen
from worker.telemetry.live_view import TrainingView
from worker.telemetry.page import ViewerPage
from worker.telemetry.progress import Activity
from worker.telemetry.rows import Rows
from worker.telemetry.tap import Tap

WARM = 20.0
"""Seconds for the page to start and draw its first frames."""
LATE = 8.0
"""Seconds for the last frames to arrive."""
SHOWN = 4
"""Worlds in the view."""
PARTS = (
    ("the step's end → its row read by `muster view`", 0, 1),
    ("→ the frame logged: handed to Rerun, which sends it to its server", 1, 2),
    ("→ the frame's bytes in the page", 2, 3),
    ("→ the end of the browser's next frame", 3, 4),
    ("**from the step to the page**", 0, 3),
    ("**from the step to the end of the next frame**", 0, 4),
)
SCRIPT = """
const fetched = window.fetch;
window.arrived = {};
window.frames = 0;
const clock = () => performance.timeOrigin + performance.now();
const count = () => { window.frames++; requestAnimationFrame(count); };
requestAnimationFrame(count);
window.fetch = async (...given) => {
  const answer = await fetched(...given);
  if (!answer.body || !(answer.headers.get("content-type") || "").startsWith("application/grpc")) return answer;
  let rest = "";
  const body = answer.body.pipeThrough(new TransformStream({transform(chunk, out) {
    const now = clock();
    out.enqueue(chunk);
    const text = rest + new TextDecoder("latin1").decode(chunk);
    for (const found of text.matchAll(/MARK([A-Za-z]{12})/g)) {
      if (found[1] in window.arrived) continue;
      const times = window.arrived[found[1]] = [now, null];
      requestAnimationFrame(() => requestAnimationFrame(() => { times[1] = clock(); }));
    }
    rest = text.slice(-15);
  }}));
  return new Response(body, {status: answer.status, statusText: answer.statusText, headers: answer.headers});
};
"""


def train(task: str, worlds: int, folder: Path) -> None:
    """Train until SIGTERM; write the end of each control step [ns] to a file, by the step's number in the tap."""
    loop, taps = build(task, worlds, folder / "store"), list[Tap]()
    ends = np.memmap(folder / "ends", np.int64, "w+", shape=(1 << 22,))
    step, opened = loop.task.step, Tap.open

    def timed(actions: Any) -> None:
        step(actions)
        if taps:
            ends[int(taps[-1].count) % len(ends)] = time.time_ns()

    def kept(tap: Tap) -> None:
        taps.append(tap)
        opened(tap)

    with mock.patch.object(loop.task, "step", timed), mock.patch.object(Tap, "open", kept):
        (folder / "built").touch()
        loop.train()


class Timed(TrainingView):
    """The view of a training, which records when it has read a row."""

    read = 0

    def _newest(self, shown: screen.Screen) -> Rows | None:
        rows = super()._newest(shown)
        Timed.read = time.time_ns()
        return rows


class Marked(screen.Screen):
    """Its stream has a word after each frame."""

    frames_sent: dict[str, tuple[int, int, int]] = {}
    """By word: number of the step, when its row was read, when the frame was handed to Rerun [ns]."""

    def show(self, shown: screen.ShownSteps) -> None:
        read = Timed.read
        super().show(shown)
        word = "".join(random.choices(string.ascii_letters, k=12))
        index = [rr.TimeColumn("time", timestamp=shown.times.astype("datetime64[ns]"))]
        self._rr.send_columns("mark", index, rr.TextLog.columns(text=[f"MARK{word}"]))
        self.frames_sent[word] = int(shown.steps[-1]), read, time.time_ns()


def look_on(url: str, seconds: float, stop: list[int], found: dict[str, Any]) -> None:
    """Open the page and return its script's observations; then the view ends."""
    try:
        with empty_page() as page:
            page.add_init_script(SCRIPT)
            page.goto(url, timeout=120_000)
            time.sleep(WARM)
            found["from"], before = time.time_ns(), page.evaluate("window.frames")
            time.sleep(seconds)
            found["rate"], found["to"] = (page.evaluate("window.frames") - before) / seconds, time.time_ns()
            time.sleep(LATE)
            found["arrived"] = page.evaluate("window.arrived")
    finally:
        stop.append(signal.SIGINT)


def measure(task: str, worlds: int, seconds: float, folder: Path) -> dict[str, Any]:
    """Times of each frame that arrived [ms], shape ``(frames, 5)``: step, read, logged, arrived, next frame; and the facts of the table."""
    command = [
        sys.executable,
        "-m",
        "benchmarks.view_latency",
        "--task",
        task,
        "--worlds",
        str(worlds),
        "--train",
        str(folder),
    ]
    trained = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        while not (folder / "built").exists():
            if trained.poll() is not None:
                raise SystemExit("the training ended before it began")
            time.sleep(0.1)
        (run,) = (Run(each) for each in (folder / "store" / "runs").iterdir())
        stop, found = list[int](), dict[str, Any]()

        def start() -> ViewerPage:
            page = ViewerPage(None, "256MB")
            threading.Thread(target=look_on, args=(page.url, seconds, stop, found)).start()
            return page

        with mock.patch.object(screen, "Screen", Marked):
            Timed(run, "bench", SHOWN, stop, Activity()).show(start)
    finally:
        trained.terminate()
        trained.wait()
    ends = np.memmap(folder / "ends", np.int64, "r")
    rows = [
        (ends[step] / 1e6, read / 1e6, logged / 1e6, *found["arrived"].get(word, (None, None)))
        for word, (step, read, logged) in Marked.frames_sent.items()
        if found["from"] <= read < found["to"]
    ]
    whole = np.array([row for row in rows if None not in row], float)
    if len(whole) < 10:
        raise SystemExit(f"only {len(whole)} of {len(rows)} frames were seen in the page; is Chromium's page open?")
    return {
        "task": task,
        "worlds": worlds,
        "seconds": seconds,
        "times": whole,
        "sent": len(rows),
        "rate": found["rate"],
    }


def table(row: dict[str, Any]) -> str:
    """Markdown."""
    times = row["times"]
    lines = [
        "# How old what the live view shows is",
        "",
        f"`python -m benchmarks.view_latency` on {machine()}: {row['task']} trains with {row['worlds']} worlds, `muster view` shows {SHOWN} of "
        f"them, Chromium without a display has its page open and draws with a software rasteriser on the same cores, {row['rate']:.1f} frames "
        f"a second. In {row['seconds']:.0f} s {row['sent']} frames were sent, and of {len(times)} all times were seen. {reported([row])}",
        "",
        "| what [ms] | p50 | p99 | max |",
        "|---|--:|--:|--:|",
    ]
    for name, first, last in PARTS:
        taken = times[:, last] - times[:, first]
        p50, p99 = np.percentile(taken, (50, 99))
        lines.append(f"| {name} | {p50:.1f} | {p99:.1f} | {taken.max():.1f} |")
    lines += [
        "",
        "A training's thread looks at the tap 20 times a second and so does the view, so that a row is up to 50 ms old at each of the two. "
        "What is read is the newest row; those between are dropped. The last line holds where Rerun draws a frame as soon as it has arrived.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Ant")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    parser.add_argument("--train", type=Path, help=argparse.SUPPRESS)
    add_option(parser)
    options = parser.parse_args()
    if options.train:
        train(options.task, options.worlds, options.train)
        return
    watch = Watch(options.loaded_anyway)
    with tempfile.TemporaryDirectory() as folder:
        row = measure(options.task, options.worlds, options.seconds, Path(folder))
    text = table(row | watch.check("while it was measured"))
    (options.out / "view.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
