"""Two controllers of two homes on one store, asked at the same moment to continue the same run: one class of a torture."""

from __future__ import annotations

import random
import sys
import threading
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

from orchestrator.client import Client
from orchestrator.domain.errors import ApiError
from tests.support.definitions import container, multinode
from tests.support.faults.home import Home
from tests.support.processes import end_all
from tests.support.waiting import wait_for

RACES = 4
SCRIPT = """
import os, time
file = open(os.environ["SHARED"], "a")
end = time.monotonic() + 1
while time.monotonic() < end:
    file.write(f"{os.environ['MUSTER_EPOCH']} {os.environ['AWS_BATCH_JOB_ID']}\\n")
    file.flush()
    time.sleep(0.02)
"""


def second_controller_round(directory: Path, seed: int) -> tuple[Counter[str], list[str]]:
    """Submit runs to both at once; every attempt of a run must have an epoch of its own, and every job must end."""
    rng = random.Random(seed)
    homes = [Home(directory / f"home-{name}", "--store", str(directory / "store")) for name in "ab"]
    done, wrong = Counter(controllers=len(homes)), list[str]()
    try:
        for home in homes:
            home.serve()
        clients = [Client(home.url) for home in homes]
        for race in range(RACES):
            run, shared = f"run-{race}", directory / f"written-{race}"
            environment = {"MUSTER_RUN": run, "SHARED": str(shared)}
            _race(clients, environment, rng.choice((1, 2, 3)), rng.choice((0.0, 0.0, rng.uniform(0, 0.05))), done)
            jobs = wait_for(partial(_ended, homes, run), 90, f"the jobs of {run} end")
            epochs = [each["epoch"] for job in jobs for each in job["attempts"]]
            done["attempts"] += len(epochs)
            if len(set(epochs)) != len(epochs):
                wrong.append(f"two attempts had one epoch: {sorted(epochs)}")
            owners = set(shared.read_text().splitlines()) if shared.exists() else set()
            if len({line.split()[0] for line in owners}) != len(owners):
                wrong.append(f"two jobs wrote under one epoch: {sorted(owners)}")
    finally:
        for home in homes:
            home.close()
        end_all(directory)
    return done, wrong


def _race(clients: list[Client], environment: dict[str, str], attempts: int, apart: float, done: Counter[str]) -> None:
    """Submit to both, ``apart`` seconds from each other; a refusal is an answer, too."""
    barrier = threading.Barrier(len(clients))
    answers: list[str] = []

    def submit(client: Client, pause: float) -> None:
        definition = client.batch("RegisterJobDefinition", **_definition(environment, attempts))["jobDefinitionArn"]
        barrier.wait()
        threading.Event().wait(pause)
        try:
            client.batch("SubmitJob", jobName="shared", jobQueue="default", jobDefinition=definition)
            answers.append("jobs")
        except ApiError:
            answers.append("refused")

    threads = [threading.Thread(target=submit, args=(each, apart * number)) for number, each in enumerate(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    done.update(answers)


def _definition(environment: dict[str, str], attempts: int) -> dict[str, Any]:
    needs = container([sys.executable, "-c", SCRIPT], env=environment)
    return multinode("shared", needs, retryStrategy={"attempts": attempts})


def _ended(homes: list[Home], run: str) -> list[dict[str, Any]] | None:
    """The run's jobs of all homes, once each is over."""
    jobs = [job for home in homes for job in home.jobs(run)]
    return jobs if all(job["status"] in ("SUCCEEDED", "FAILED") for job in jobs) else None
