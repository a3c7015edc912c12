"""The progress of a job, followed to its end: a live bar on a terminal, plain lines otherwise, and the results."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.text import Text

from orchestrator.cli.listings import duration, number, show_facts
from orchestrator.cli.terminal import Console, echo, echo_raw, one_line, visible
from orchestrator.client import Client, named
from orchestrator.domain import reasons
from orchestrator.domain.errors import ApiError, Unreachable
from orchestrator.domain.job import TERMINAL, WAITING
from shared_store.contract.phases import Phase, phase_in, shown_phase
from shared_store.volume.evaluations import in_one_line
from shared_store.volume.metrics import warnings_of

_POLL = 0.3
_OF_LIBRARIES = re.compile(r'Warp CUDA warning|\{"|(?:DEBUG|INFO):[\w.]+:')
"""Beginning of a line that a library logs: a machine without GPUs, JSON, or details by Python's logging."""
_COUNT = re.compile(r" \d+/\d+$")
"""Behind a phase."""
_PLAIN_INTERVAL = 2.0
"""Seconds between two plain lines of progress."""


def follow(client: Client, job_id: str) -> int:
    """Show a job until it ends, then its results; returns the command's exit code (0 if it SUCCEEDED).

    If the controller goes away, wait for it or replace it (:attr:`Client.successor`). Raises Unreachable.
    """
    detail = client.get(f"/api/jobs/{job_id}")
    if detail["kind"] != "train":
        for lines in log_lines(client, job_id, follow=True):
            echo_raw("\n".join(map(_format, lines)))
        return summary(client, job_id)
    display = _Bar(detail) if sys.stdout.isatty() else _Lines(detail)
    client.notify = display.note
    seen, drawn = 0, False
    with display:
        while True:
            try:
                job = client.get(f"/api/jobs/{job_id}", store=False)
                has_ended, records = job["status"] in TERMINAL, []
                has_run = any(attempt["epoch"] for attempt in job["attempts"])
                # the run exists once an attempt has taken it: not at the beginning, and never if no attempt started
                while has_run and (page := client.get(f"/api/runs/{detail['run']}/metrics", after=seen)):
                    records, seen = page, page[-1]["iteration"]
            except Unreachable:
                client.await_return()
                time.sleep(_POLL)
                continue
            # not iterations before a resume
            records = [each for each in records if each["time"] * 1000 >= detail["createdAt"]]
            display.show(job, records[-1] if records else None)
            if (
                not drawn and phase_in(job) is Phase.DRAWING
            ):  # the other results are there, and need not wait for the picture
                drawn = True
                with suppress(Unreachable):
                    show_facts(_facts(client.get(f"/api/jobs/{job_id}")), width=12)
            if has_ended:
                break
            time.sleep(_POLL)
    return summary(client, job_id, ("picture", "run") if drawn else None)


@contextmanager
def following(job_id: str) -> Iterator[None]:
    """A block that follows a job. Where the controller refuses its requests from now on, the error says that the job is not stopped."""
    try:
        yield
    except ApiError as error:
        if error.status != 403:
            raise
        short = reasons.short_id(job_id)
        words = f"job {short} is not stopped, but the controller refuses to show it now: {error}; then: muster logs {short} -f"
        raise ApiError(words, error.status) from None


def follow_main(client: Client, job_id: str) -> int:
    """Print the main rank's output until a job ends, and how it ended if it did not succeed; returns the command's exit code."""
    for lines in log_lines(client, job_id, follow=True):
        for line in lines:
            if line["rank"] == 0 and not _OF_LIBRARIES.match(line["text"]):
                echo(line["text"])
    return _ended(client, job_id, err=False)


def _cause(attempt: Mapping[str, Any]) -> dict[str, Any] | None:
    """The node that the attempt's reason names, else the first with an error of its own."""
    nodes: list[dict[str, Any]] = attempt["nodes"]
    if named := re.match(r"node (\d+): ", attempt["statusReason"] or ""):
        return next((node for node in nodes if node["index"] == int(named[1])), None)
    return next((node for node in nodes if node.get("error")), None)


def await_end(client: Client, job_id: str) -> int:
    """Wait for a job's end without output on standard output; a failure is printed on standard error. Returns the command's exit code."""
    for _ in client.logs(job_id, follow=True):
        pass
    return _ended(client, job_id, err=True)


def _ended(client: Client, job_id: str, err: bool) -> int:
    """0 of a job that SUCCEEDED, else its summary and the exit code of that."""
    return 0 if client.get(f"/api/jobs/{job_id}")["status"] == "SUCCEEDED" else summary(client, job_id, err=err)


def summary(client: Client, job_id: str, only: Collection[str] | None = None, *, err: bool = False) -> int:
    """Print how a job ended and where its results are; returns the command's exit code.

    Args:
        client: The controller's.
        job_id: Of the job.
        only: Names of the facts of one that succeeded; None: all.
        err: Whether it is printed on standard error.
    """
    detail = client.get(f"/api/jobs/{job_id}")
    console = Console(highlight=False, soft_wrap=True, stderr=err)
    succeeded = detail["status"] == "SUCCEEDED"
    reason = "" if succeeded else f": {one_line(detail['statusReason'])}"
    status = (detail["status"], "green" if succeeded else "red")
    console.print(Text.assemble(status, f"  {reasons.named(detail['name'], detail['id'])}{reason}"))
    attempt = detail["attempts"][-1] if detail["attempts"] else None
    first = _cause(attempt) if attempt and not succeeded else None
    if first and first.get("error") and one_line(first["error"]) not in one_line(detail["statusReason"]):
        echo(f"  first error: node {first['index']}: {one_line(first['error'])}", err)
    facts = _facts(detail, first)
    if not succeeded:
        facts |= {"evaluation": "", "best": ""}
    shown = {name: fact for name, fact in facts.items() if not (succeeded and only) or name in only}
    show_facts(shown, width=12, err=err)
    if not succeeded and facts["checkpoint"] and detail["kind"] == "train":
        label = "once that is corrected:" if attempt and attempt.get("fault") else "continue with: "
        echo(f"  {label} muster resume {detail['run']}", err)
    return 0 if succeeded else 1


def _facts(detail: Mapping[str, Any], cause: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The results of a job, and where they are. ``cause``: the node whose log tells why it failed."""
    results, attempts = detail["results"] or {}, detail["attempts"]
    evaluation = results.get("evaluation")
    return {
        "evaluation": in_one_line(evaluation) if evaluation else "",
        "best": describe_best(detail["run"], results.get("best")),
        "checkpoint": results.get("checkpoint"),
        "log": (cause or attempts[-1]["nodes"][0])["log"] if attempts else None,
        **{name: results.get(name) for name in ("plot", "picture")},
        "run": detail["run"],
    }


def outcome(detail: Mapping[str, Any]) -> dict[str, Any]:
    """What scripts want to know of an ended job."""
    names = {"jobId": "id", "jobName": "name"} | {name: name for name in ("status", "statusReason", "run", "results")}
    return {name: detail[key] for name, key in names.items()}


def describe_best(run: str, best: Mapping[str, Any] | None) -> str:
    """The best checkpoint by evaluations in one line; empty without at least two to compare."""
    if not best:
        return ""
    return f"{run}@{best['iteration']}, mean return {best['mean']:.2f}, best of {best['of']} evaluated checkpoints"


def log_lines(client: Client, job: str, **query: Any) -> Iterator[list[dict[str, Any]]]:
    """The lines of a job's log, many at a time; standard error has why it waits, and what else its follower waits for.

    Raises ApiError, Unreachable.
    """
    shown = ""

    def explain() -> None:
        """Print why the job waits, if that is new."""
        nonlocal shown
        with suppress(ApiError, Unreachable):  # the reader of the log meets it, too
            if (text := _why_waiting(client, job)) and text != shown:
                echo(text, err=True)
            shown = text

    def batches() -> Iterator[list[dict[str, Any]]]:
        for lines in client.log_batches(job, **query):
            if lines:
                yield lines
            else:
                explain()

    client.notify = lambda line: echo(line, err=True)
    explain()
    return batches()


def _why_waiting(client: Client, job: str) -> str:
    """A job's state and why it waits; empty before a scheduling pass has seen it, once it runs, or is over. Raises ApiError, Unreachable."""
    found = client.get(f"/api/jobs/{named(job)}", store=False)
    if found["status"] in ("SUBMITTED", "RUNNING", *TERMINAL) or found["statusReason"] == WAITING:
        return ""
    return f"{reasons.named(found['name'], found['id'])} {found['status']}: {one_line(found['statusReason'] or '')}"


def _format(line: dict[str, Any]) -> str:
    return f"[node {line['node']} rank {'-' if line['rank'] is None else line['rank']}] {visible(line['text'], colours=True)}"


def shown_metrics(record: Mapping[str, Any]) -> str:
    """The metrics that a task shows in the progress, such as ``  progress 83.1 %``."""
    shown = record.get("shown")
    return "".join(f"  {one_line(f'{name} {text}')}" for name, text in shown.items()) if isinstance(shown, dict) else ""


class Activity:
    """A job's current activity: on a terminal one overwritten line, otherwise lines on standard error."""

    def __init__(self) -> None:
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            text = TextColumn("{task.description}", markup=False)
            self._bar = Progress(text, BarColumn(bar_width=24), console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task("", total=None)

    def wait(self, client: Client, job_id: str) -> None:
        """Until the job has started, show its state and why it waits; if the controller goes away, wait for it. Raises Unreachable."""
        shown = ""
        while True:
            try:
                text = _why_waiting(client, job_id)
            except Unreachable:
                client.await_return()
                continue
            if not text:
                return
            if text != shown:
                self.show(text)
            shown = text
            time.sleep(_POLL)

    def show(self, text: str) -> None:
        """Show the current activity; ``3 of 8`` at the end moves a bar."""
        if self._bar is None:
            echo(text, err=True)
            return
        self._bar.start()
        found = re.search(r"(\d+) of (\d+)$", text)
        done, total = (int(found[1]), int(found[2])) if found else (0, None)
        self._bar.update(self._task, description=one_line(text), completed=done, total=total)

    def end(self) -> None:
        """Clear the line; later output is printed as usual."""
        if self._bar is not None:
            self._bar.stop()

    def __enter__(self) -> Activity:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


class _Display:
    """Common state of both displays: progress, phase and remaining time."""

    def __init__(self, detail: dict[str, Any]) -> None:
        self.total = int(detail["spec"]["train"]["iterations"])
        self.nodes, self.run = int(detail["nodes"]), str(detail["run"])
        self.name = reasons.named(detail["name"], detail["id"])
        self.iteration = 0
        """The last one that the present attempt has done."""
        self._first: tuple[float, int] | None = None
        self._attempt, self._phase, self._since = 0, "", time.monotonic()

    def note(self, text: str) -> None:
        """Show why nothing happens."""
        echo(text, err=True)

    def enter(self, job: dict[str, Any]) -> bool:
        """Note what the job does at present; returns whether that is something else than before."""
        if attempts := job["attempts"]:  # another one may have another number of nodes
            self.nodes = len(attempts[-1]["nodes"])
            self.iteration = self.iteration if len(attempts) == self._attempt else 0
            self._attempt = len(attempts)
        phase = phase_in(job)
        if phase and phase.is_before_training and self.iteration:
            phase = None  # the metrics are newer than the node's report
        text = shown_phase(job) if phase else "" if self.iteration else "loading libraries"
        before, self._phase = self._phase, text if job["status"] == "RUNNING" else ""
        if _COUNT.sub("", self._phase) == _COUNT.sub("", before):
            return False
        self._since = time.monotonic()
        return True

    @property
    def doing(self) -> str:
        """What the job does at present, and since when; empty while iterations show it."""
        if not self._phase or (self.iteration and self._phase == Phase.TRAINING):
            return ""
        return f"{self._phase} ({time.monotonic() - self._since:.0f} s)"

    def values(self, record: dict[str, Any]) -> str:
        """An iteration in one line."""
        iteration = record["iteration"]
        parts = [
            f"{iteration}/{self.total}",
            f"reward {number(record.get('reward')) or '-'}",
            f"length {number(record.get('episode_length'), '.1f') or '-'}{shown_metrics(record)}",
            f"steps/s {number(record.get('steps_per_second'), ',.0f') or '-'}",
            f"ETA {self.eta(record)}" if iteration < self.total else "",
            f"nodes {self.nodes}",
        ]
        return "  ".join(filter(None, parts))

    def eta(self, record: dict[str, Any]) -> str:
        """Remaining time at the pace since the first displayed iteration (at first: of that iteration), as h:mm:ss."""
        now, iteration = time.monotonic(), record["iteration"]
        if self._first is None or iteration < self._first[1]:
            self._first = (now, iteration)
        done = iteration - self._first[1]
        pace = (now - self._first[0]) / done if done else record.get("iteration_seconds", 0.0)
        return duration((self.total - iteration) * pace)


class _Bar(_Display):
    """A live bar on a terminal."""

    def __init__(self, detail: dict[str, Any]) -> None:
        super().__init__(detail)
        self._progress = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[text]}", markup=False),
            console=Console(),
        )
        self._task: TaskID = self._progress.add_task(self.name, total=self.total, text="")

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def note(self, text: str) -> None:
        self._progress.update(self._task, text=one_line(text))

    def show(self, job: dict[str, Any], record: dict[str, Any] | None) -> None:
        self.enter(job)
        if record:
            self.iteration = record["iteration"]
            warnings = [f"warning: {one_line(each)}" for each in warnings_of(record, self.run)]
            text = "  ".join([self.values(record), *warnings])
            self._progress.update(self._task, completed=self.iteration, text=text)
        elif job["status"] not in ("RUNNING", *TERMINAL):
            self._progress.update(self._task, text=f"{job['status']}: {one_line(job['statusReason'] or '')}")
        elif self.doing:
            self._progress.update(self._task, text=self.doing)


class _Lines(_Display):
    """Plain lines for logs and pipes."""

    def __init__(self, detail: dict[str, Any]) -> None:
        super().__init__(detail)
        self._state = self._printed_phase = ""
        self._latest: dict[str, Any] | None = None
        self._printed = 0.0

    def __enter__(self) -> _Lines:
        echo(f"{self.name}: following")
        return self

    def __exit__(self, *_: object) -> None:
        self._flush()

    def show(self, job: dict[str, Any], record: dict[str, Any] | None) -> None:
        state = f"{job['status']}: {one_line(job['statusReason'] or '')}"
        if state != self._state and job["status"] not in TERMINAL:
            self._flush()
            echo(state)
            self._state = state
        if record:
            self.eta(record)
            self._latest, self.iteration = record, record["iteration"]
        is_new, is_due = self.enter(job), time.monotonic() - self._printed >= _PLAIN_INTERVAL
        if self.doing and (is_new or (is_due and self._phase != self._printed_phase)):
            self._flush()
            echo(self._phase)
            self._printed_phase, self._printed = self._phase, time.monotonic()
        elif is_due:
            self._flush()

    def _flush(self) -> None:
        if self._latest is None:
            return
        echo(f"iteration {self.values(self._latest)}")
        for each in warnings_of(self._latest, self.run):
            echo(f"warning: {one_line(each)}")
        self._latest, self._printed = None, time.monotonic()
