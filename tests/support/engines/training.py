"""A small cart-pole training on any engine, and whether two of them ended with the same bits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from orchestrator.spec import file as specfile
from orchestrator.spec.compile import compile_definition
from tests.conftest import REPOSITORY, Serving
from tests.support.definitions import submission_of
from tests.support.engines.images import PATH, SUPERVISED, host_files
from tests.support.waiting import PATIENCE

SMALL = ("nodes=2", "train.worlds=16", "checkpoint.every=4", "resources.cpus=0.5", "train.config.episode_seconds=0.5")


def submit(serving: Serving, run: str, engine: str, iterations: int, *more: str) -> str:
    """Go on with ``run`` until it has that many iterations; returns the job id."""
    changes = [*SMALL, f"train.iterations={iterations}", *more]
    spec = specfile.load(str(REPOSITORY / "job_specs" / "cartpole.yaml"), changes)
    queue = serving.client.get("/api/capacity")["engines"][engine]
    request = compile_definition(spec, str(REPOSITORY))
    container = request["nodeProperties"]["nodeRangeProperties"][0]["container"]
    container["environment"] += [{"name": "MUSTER_RUN", "value": run}, {"name": "MUSTER_PICTURE", "value": "0"}]
    if engine == "docker":
        container |= {"image": SUPERVISED, **host_files()}
        container["environment"].append({"name": "PATH", "value": PATH})
    arn = serving.client.batch("RegisterJobDefinition", **request)["jobDefinitionArn"]
    submission = {**submission_of(spec, arn), "jobQueue": queue}
    job: str = serving.client.batch("SubmitJob", **submission)["jobId"]
    return job


def same_bits(store: Path, first: str, second: str) -> str:
    """What ``worker.bitwise_diff`` says of two runs, which must be equal."""
    compared = subprocess.run(
        [sys.executable, "-P", "-m", "worker.bitwise_diff", first, second],
        env={**os.environ, "MUSTER_STORE": str(store)},
        capture_output=True,
        text=True,
        timeout=60 * PATIENCE,
    )
    assert compared.returncode == 0 and compared.stdout.startswith("equal: "), compared.stdout + compared.stderr
    return compared.stdout
