"""One run under fire: submitted, struck again and again by a plan, brought to its end, judged."""

from __future__ import annotations

import json
import signal
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from tests.support.faults.checks import Reference, Verdict, judge
from tests.support.faults.home import Broken, Home, open_commit, reached
from tests.support.faults.schedule import Blow, Plan
from tests.support.processes import Process, end_all, gang_members

HANG_SECONDS = 240.0
"""How long nothing at all may change."""
_NOTICE_SECONDS = 90.0
"""Within what a process that was frozen for good must have been found."""
_LOOK_SECONDS = 0.25


@dataclass
class Hit:
    """A blow that landed."""

    target: str
    signal: str
    in_commit: bool
    """A hidden checkpoint directory was there before and after the signal."""


@dataclass
class Result:
    """A run, from the first blow to the verdict."""

    plan: Plan
    hits: list[Hit] = field(default_factory=list)
    verdict: Verdict = field(default_factory=Verdict)
    controller_starts: int = 0
    seconds: float = 0.0


def write_spec(path: Path, nodes: int, attempts: int, iterations: int, keep: int, steps: int = 16) -> Path:
    """The job: cheap iterations, many checkpoints. ``keep`` and ``attempts`` change nothing in what is computed."""
    ppo = {"steps": steps, "epochs": 1, "minibatches": 2, "hidden_sizes": [16]}
    spec = {
        "name": "torture",
        "nodes": nodes,
        "resources": {"cpus": 0.5, "memory": "64MiB"},
        "train": {"task": "Cartpole", "worlds": 8, "iterations": iterations, "seed": 7, "ppo": ppo},
        "checkpoint": {"every": 10, "keep": keep},
        "retry": {"attempts": attempts},
        "stall_timeout": 6,
    }
    path.write_text(json.dumps(spec))  # JSON is YAML
    return path


def run_straight(home: Home, nodes: int, iterations: int, steps: int = 16) -> Reference:
    """The reference: the same job, undisturbed; every checkpoint is kept."""
    spec = write_spec(home.path / f"straight-{nodes}.yaml", nodes, 1, iterations, 10_000, steps)
    submitted, output = home.command("submit", str(spec))
    if submitted is None:
        raise Broken(f"submit: {output}")
    run = f"torture-{submitted['jobId'][:8]}"
    iteration, deadline = 0, time.monotonic() + HANG_SECONDS
    while (job := home.jobs(run)[-1])["status"] != "SUCCEEDED":
        if (now := reached(home.run(run), 1)) != iteration:  # on a busy machine it may take long, as long as it moves
            iteration, deadline = now, time.monotonic() + HANG_SECONDS
        if job["status"] == "FAILED" or time.monotonic() > deadline:
            raise Broken(f"the straight run is {job['status']}: {job['status_reason']}")
        time.sleep(0.2)
    return Reference(home.run(run))


class _Frozen(NamedTuple):
    """A process that was frozen."""

    process: Process
    since: float
    until: float
    """Times of the blow and of its end (monotonic [s])."""
    trained: bool
    """Whether the gang trained."""
    starts: int
    """How often the controller had been started by then."""


class Fire:
    """Carries out one plan on one home."""

    def __init__(self, home: Home, plan: Plan, iterations: int, say: Callable[[str], None]) -> None:
        self.home, self.plan, self.iterations, self.say = home, plan, iterations, say
        self.result = Result(plan)
        self.found = self.result.verdict.violations
        self._restart_at: float | None = None
        self._thaw_controller_at: float | None = None
        self._frozen: list[_Frozen] = []
        self._killed: set[Process] = set()
        self._next_look = 0.0
        self._over = False
        self._state: Any = None
        self._changed = time.monotonic()
        self._jobs: list[dict[str, Any]] = []

    def carry_out(self, reference: Reference) -> Result:
        """Submit, strike, wait for the end, judge."""
        started, starts = time.monotonic(), self.home.starts
        try:
            spec = write_spec(
                self.home.path / "spec.yaml", self.plan.nodes, self.plan.attempts, self.iterations, keep=3
            )
            submitted, output = self.home.command("submit", str(spec))
            if submitted is None:
                raise Broken(f"submit: {output}")
            self.run = self.home.run(f"torture-{submitted['jobId'][:8]}")
            for blow in self.plan.blows:
                if not self._strike(blow):
                    break
            while self._tend():
                time.sleep(0.05)
            self._thaw_all()
            judge(
                self.result.verdict,
                self.home,
                self.run,
                reference,
                sum(hit.target == "controller" for hit in self.result.hits),
            )
        except Broken as broken:
            self.found.append(str(broken))
        except Exception as error:  # a defect of the harness must not pass for a pass
            traceback.print_exc()
            self.found.append(f"the harness failed: {error!r}")
        finally:
            self._thaw_all()
            end_all(self.home.path)
        self.result.controller_starts = self.home.starts - starts
        self.result.seconds = time.monotonic() - started
        return self.result

    # -- blows --------------------------------------------------------------------------------------------------------

    def _strike(self, blow: Blow) -> bool:
        """Wait for the blow's moment and strike; False where the run is over before that."""
        if blow.target == "controller":
            return self._strike_controller(blow)
        gentle = blow.freeze or blow.moment in ("any", "commit")
        if blow.moment != "again" and gentle and blow.ends_gang and not self._wait(self._trains):
            return False
        if blow.moment in ("any", "again") and not self._sleep(blow.delay):
            return False
        if blow.moment == "start" and not (self._wait(lambda: self._targets(blow)) and self._sleep(blow.delay)):
            return False
        targets: list[Process] = []
        while not targets:
            if not self._wait(lambda: self._targets(blow)):
                return False
            if blow.moment == "commit" and not self._await_commit(blow.delay, lambda: self._targets(blow)):
                return False
            targets = self._targets(blow)
            if targets and not self._hit(blow, targets[int(blow.choice * len(targets))]):
                targets = []
                time.sleep(0.05)
        return True

    def _hit(self, blow: Blow, process: Process) -> bool:
        epoch = int(process.gang.rpartition("/")[2])
        trains = 0 < reached(self.run, epoch) < self.iterations
        commit = open_commit(self.run)
        if blow.freeze and not trains:  # nobody is asked to notice: a stall is the lack of an iteration after another
            return False
        if not process.strike(signal.SIGSTOP if blow.freeze else signal.SIGKILL):
            return False
        if not blow.freeze:
            self._killed.add(process)
        inside = commit is not None and (self.run.checkpoints / commit).exists()
        if blow.freeze:
            now = time.monotonic()
            self._frozen.append(_Frozen(process, now, now + (blow.pause or 1e9), trains, self.home.starts))
        self._note(blow, f"{process} at iteration {reached(self.run, epoch)} of epoch {epoch}", inside)
        return True

    def _strike_controller(self, blow: Blow) -> bool:
        if blow.moment == "start":
            if not self._wait(lambda: self.home.up):
                return False
            if self._thaw_controller_at is None and self.home.strike(signal.SIGKILL):
                self._note(blow, "controller", False)
                self.home.start()
        if not self._sleep(blow.delay) or not self._wait(lambda: self.home.up):
            return False
        if blow.moment == "commit" and not self._await_commit(blow.delay, lambda: True):
            return False
        commit = open_commit(self.run)
        if self.home.strike(signal.SIGSTOP if blow.freeze else signal.SIGKILL):
            inside = commit is not None and (self.run.checkpoints / commit).exists()
            self._note(blow, "controller", inside)
            now = time.monotonic()
            if blow.freeze:
                self._thaw_controller_at = now + (blow.pause or 0.0)
            else:
                self._thaw_controller_at, self._restart_at = None, now + (blow.pause or 0.0)
        return True

    def _note(self, blow: Blow, what: str, inside: bool) -> None:
        name = "SIGSTOP" if blow.freeze else "SIGKILL"
        self.result.hits.append(Hit(blow.target, name, inside))
        self.say(f"{name} {what} ({blow.moment}{', inside a commit' if inside else ''})")

    def _targets(self, blow: Blow) -> list[Process]:
        """Processes to choose from, without those that are dying of an earlier blow."""
        found = gang_members(self.home.path)
        return [process for process in found if process.role == blow.target and process not in self._killed]

    def _await_commit(self, delay: float, targets: Callable[[], Any]) -> bool:
        """Wait until a commit is under way; False where the run is over."""
        while targets():
            deadline = time.monotonic() + 0.3
            while time.monotonic() < deadline:
                if open_commit(self.run):
                    time.sleep(delay)
                    return True
                time.sleep(0.001)
            if not self._tend():
                return False
        return self._tend()

    # -- meanwhile ----------------------------------------------------------------------------------------------------

    def _trains(self) -> bool:
        attempts = [attempt for job in self._jobs for attempt in job["attempts"]]
        return bool(attempts) and not attempts[-1]["stopped_at"] and reached(self.run, attempts[-1]["epoch"]) > 0

    def _wait(self, condition: Callable[[], Any]) -> bool:
        while self._tend():
            if condition():
                return True
            time.sleep(0.05)
        return False

    def _sleep(self, seconds: float) -> bool:
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if not self._tend():
                return False
            time.sleep(0.02)
        return True

    def _tend(self) -> bool:
        """Start and thaw what is due, look whether all is well; False once the run is over."""
        now = time.monotonic()
        if self._thaw_controller_at is not None and now >= self._thaw_controller_at:
            self.home.strike(signal.SIGCONT)
            self._thaw_controller_at = None
        if not self.home.up:
            if self._restart_at is None:
                raise Broken(f"the controller ended by itself; see {self.home.errors}")
            if now >= self._restart_at:
                self.home.start()
                self._restart_at = None
        self._thaw(now)
        if now >= self._next_look and not self._over:
            self._next_look = now + _LOOK_SECONDS
            self._look(now)
        return not self._over

    def _thaw(self, now: float) -> None:
        for each in list(self._frozen):
            if each.process not in gang_members(self.home.path):
                self._frozen.remove(each)
            elif now >= each.until or self._is_named(each):
                each.process.strike(signal.SIGCONT)
                self._frozen.remove(each)
            elif now - each.since > _NOTICE_SECONDS:
                when = "while it trained" if each.trained else "while it did not train"
                self.found.append(f"nobody noticed in {_NOTICE_SECONDS:g} s that {each.process} was frozen {when}")
                each.process.strike(signal.SIGCONT)
                self._frozen.remove(each)

    def _is_named(self, frozen: _Frozen) -> bool:
        """Whether the job says that the supervisor is unreachable: all that a controller can do that was started after the blow."""
        if frozen.process.role != "supervisor" or self.home.starts == frozen.starts or not self._jobs:
            return False
        return "has not come to this controller" in (self._jobs[-1]["status_reason"] or "")

    def _look(self, now: float) -> None:
        jobs = self._jobs = self.home.jobs(self.run.name)
        closed = {
            f"{job['id']}/{attempt['number']}/{attempt['epoch']}"
            for job in jobs
            for attempt in job["attempts"]
            if attempt["stopped_at"]
        }
        if zombies := [process for process in gang_members(self.home.path) if process.gang in closed]:
            self.found.append(f"outlive their attempt: {', '.join(map(str, zombies))}")
            end_all(self.home.path)
        job = jobs[-1]
        epoch = job["attempts"][-1]["epoch"] if job["attempts"] else 0
        state = (len(jobs), epoch, reached(self.run, epoch), job["status"], job["status_reason"])
        if state != self._state:
            self._state, self._changed = state, now
        elif now - self._changed > HANG_SECONDS:
            left = ", ".join(map(str, gang_members(self.home.path)))
            raise Broken(f"nothing has changed for {HANG_SECONDS:g} s: {state}; processes: {left}")
        if job["status"] == "SUCCEEDED":
            self._over = True
        elif job["status"] == "FAILED":
            self._resume(job)

    def _resume(self, job: dict[str, Any]) -> None:
        """The attempts are spent: the run goes on in another job, as a person would have it."""
        if not job["attempts"] or job["attempts"][-1]["ending"] != "failed":
            raise Broken(f"job {job['id']} failed: {job['status_reason']}")
        if self._thaw_controller_at is not None:
            self.home.strike(signal.SIGCONT)
            self._thaw_controller_at = None
        self._restart_at = None
        resumed, output = self.home.command("resume", self.run.name)
        if resumed is None:
            raise Broken(f"the run could not be resumed after its attempts were spent: {output}")
        self.say(f"resumed from iteration {resumed['iteration']} by another job")
        self._next_look = 0.0

    def _thaw_all(self) -> None:
        for each in self._frozen:
            each.process.strike(signal.SIGCONT)
        self._frozen.clear()
        if self._thaw_controller_at is not None:
            self.home.strike(signal.SIGCONT)
            self._thaw_controller_at = None
