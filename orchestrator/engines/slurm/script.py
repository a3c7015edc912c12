"""The sbatch script of a gang: its request to Slurm, one ``srun`` task per node, and the input of the nodes.

The nodes' input is JSON on ``srun``'s standard input, which every task gets: values keep every character, and their
size has no limit but the script's. Addresses and the port are known on the first node only: ``worker.slurm_node`` finds them there.
"""

from __future__ import annotations

import dataclasses
import json
import math
import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from orchestrator.engines.api import EngineError, Gang, node_plans
from orchestrator.engines.slurm import SBATCH
from orchestrator.engines.toolkit.mounts import mounts_of
from shared_store.volume.layout import Store

_NOTICE = 30.0
"""Seconds of a time limit's notice beyond the grace time: Slurm ends jobs on its own clock."""

_BODY = """
# USR1 means: tell every node to save and leave. It comes from Slurm before the time limit, and from the controller.
# TERM is Slurm's way to end all at once: the nodes have had it too, and get until KillWait.
asked= step=
leave() {
  asked=1
  for try in 1 2 3 4 5 6 7 8 9 10; do
    [ -n "$step" ] && kill -0 "$step" 2>/dev/null || return
    scancel --signal=TERM "$SLURM_JOB_ID.0" 2>/dev/null && return
    sleep 0.3
  done
  scancel "$SLURM_JOB_ID"  # a slurmctld that was killed forgets a young step, but not the job
}
trap leave USR1
trap : TERM

meeting=$(@python@ -P -m worker.slurm_node meet) || exit
[ -z "$asked" ] || exit 75
srun --export=ALL --nodes="$SLURM_JOB_NUM_NODES" --ntasks="$SLURM_JOB_NUM_NODES" --ntasks-per-node=1 @shape@ --mpi=none --label \\
  --kill-on-bad-exit=0 --wait=0 @python@ -P -m worker.slurm_node node "$meeting" <<'MUSTER' &
@nodes@
MUSTER
step=$!
[ -z "$asked" ] || leave
while wait "$step"; kill -0 "$step" 2>/dev/null; do :; done  # a signal, too, ends a wait
wait "$step"
"""


@dataclass(frozen=True)
class SlurmSubmission:
    """A gang's submission to Slurm."""

    script: str
    """Standard input of ``sbatch``."""
    output: str
    """Path of the job's output: the messages of ``srun`` and of the nodes' supervisors."""
    partition: str | None


def submission_for(gang: Gang) -> SlurmSubmission:
    """The submission of a gang.

    Raises:
        EngineError: The gang requests what a Slurm job can't have: nodes of different sizes, volumes, a bad option.
    """
    _check(gang)
    output = str(Store(gang.store).run(gang.run).logs(gang.job, gang.attempt) / "slurm.out")
    directives = "\n".join(f"#SBATCH {name}={_quote(value)}" for name, value in _directives(gang, output).items())
    shape = f"--cpus-per-task={_whole(gang.placements[0].cpus)}"
    # safe in a here-document: a line of this JSON never is a bare word
    body = _BODY.replace("@python@", shlex.quote(sys.executable)).replace("@shape@", shape)
    body = body.replace("@nodes@", json.dumps(_input(gang), indent=1))
    script = f"#!/bin/bash\n{directives}\n#SBATCH --no-requeue\n{body}"
    return SlurmSubmission(script, output, gang.options.get("partition"))


def _check(gang: Gang) -> None:
    shapes = {(_whole(place.cpus), place.memory, len(place.gpus)) for place in gang.placements}
    if len(shapes) > 1:
        sizes = "; ".join(f"{cpus} CPUs, {memory} MiB, {gpus} GPUs" for cpus, memory, gpus in sorted(shapes))
        raise EngineError(
            f"Slurm requires identical nodes, these differ ({sizes}); give all of them the largest resources"
        )
    for node in gang.nodes:
        if mounts := mounts_of(node.container, gang.store):
            raise EngineError(
                f"volume {mounts[0].target}: the slurm engine mounts nothing; take the volumes out of the job definition "
                "and use $MUSTER_STORE, or a path of the cluster's shared file system"
            )
    for name, value in [*gang.options.items(), ("title", gang.title)]:
        if any(ord(character) < 32 for character in value):
            raise EngineError(f"{name} {value!r} has a control character, which sbatch does not take")


def _directives(gang: Gang, output: str) -> dict[str, str]:
    place, options = gang.placements[0], gang.options
    notice = gang.grace + _NOTICE
    found = {
        "--job-name": gang.title or gang.job,
        "--comment": gang.name,
        "--nodes": str(len(gang.placements)),
        "--ntasks-per-node": "1",
        "--cpus-per-task": str(_whole(place.cpus)),
        "--mem": f"{place.memory}M",
    }
    if place.gpus:
        kind = f"{options['gpu']}:" if options.get("gpu") else ""
        found["--gpus-per-node"] = f"{kind}{len(place.gpus)}"
    if gang.timeout:
        # what the timeout means is the controller's to say; this one holds where there is none. Slurm counts in minutes and
        # sends the notice up to a minute early
        found["--time"] = str(math.ceil((gang.timeout + notice + 60) / 60))
    found |= {f"--{option.name}": value for option in SBATCH if (value := options.get(option.name))}
    if base := options.get("nice"):
        try:  # users may only lower the priority of a job: the job's own is taken off the base
            found["--nice"] = str(max(0, int(base) - gang.priority))
        except ValueError:
            raise EngineError(f"muster:nice is {base!r}, not an integer") from None
    return found | {
        "--signal": f"B:USR1@{math.ceil(notice)}",
        "--open-mode": "append",
        "--output": output.replace("%", "%%"),
        "--chdir": "/tmp",
        "--export": "ALL",
    }


def _input(gang: Gang) -> dict[str, Any]:
    """Input of all tasks; nodes that are alike are described once."""
    plans = node_plans(gang, [""] * len(gang.placements), 0)
    kinds: list[Mapping[str, Any]] = []
    of = []
    for plan in plans:
        kind = {
            "command": list(plan.command),
            "environment": dict(plan.environment),
            "ranks_per_node": plan.contract.ranks_per_node,
            "isolation": plan.contract.isolation,
        }
        if kind not in kinds:
            kinds.append(kind)
        of.append(kinds.index(kind))
    contract = dataclasses.asdict(plans[gang.main].contract)
    return {"contract": contract, "directory": gang.directory, "kinds": kinds, "kind": of}


def _whole(cpus: float) -> int:
    """Slurm hands out whole CPUs."""
    return max(1, math.ceil(cpus))


def _quote(value: str) -> str:
    """sbatch reads its lines with quotes and backslashes, and without the shell's ``$``."""
    plain = value and all(character.isalnum() or character in "/._-:,=%@[]+*&|()" for character in value)
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    return value if plain else f'"{escaped}"'
