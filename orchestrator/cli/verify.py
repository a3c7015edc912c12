"""``muster verify-resume``: check that a killed and resumed run ends bit-identical to an uninterrupted one."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import CpusOption, SetOption, SpecArgument, StoreOption
from orchestrator.cli.controllers import controller, see_through
from orchestrator.cli.submitting import load_spec, store_here, submit_spec
from orchestrator.cli.terminal import echo
from orchestrator.client import Client
from orchestrator.domain.errors import SpecError
from orchestrator.spec.model import Spec
from orchestrator.spec.sections import Resources, Retry
from shared_store.contract.error_text import counted

Connect = Callable[[], Client]


def register(app: typer.Typer) -> None:
    app.command(
        "verify-resume",
        epilog="Example:  muster verify-resume job_specs/cartpole.yaml --at 10 --set checkpoint.every=4",
    )(verify_resume)


def verify_resume(
    spec: SpecArgument,
    at: Annotated[int, typer.Option(help="Kill the main rank right after this iteration.")],
    iterations: Annotated[
        int | None, typer.Option(help="Iterations to train after that; by default as many as before.")
    ] = None,
    set_: SetOption = None,
    store: StoreOption = None,
    cpus: CpusOption = None,
) -> None:
    """Prove bit by bit that a training survives a crash.

    The spec's training runs for AT + ITERATIONS iterations twice: once uninterrupted, and once with SIGKILL of the main rank right after
    iteration AT, before anything of that iteration is written (MUSTER_KILL_AT in the job's environment, which affects only the first
    attempt). The gang restarts from its last checkpoint. Then every tensor and value of both last checkpoints, with worlds by global
    index, and every metric except times is compared bit by bit: exit 0 if all are equal, 1 at the first difference. On CPUs they must be
    equal; GPUs add in no fixed order. Both runs stay in the store.
    """
    loaded = load_spec(spec, set_, store=lambda: store_here(store))
    straight, killed = _pair(loaded, spec, at, iterations)
    for line in _notes(loaded, at):
        echo(line)
    with controller(store, cpus) as connect:
        first = _train(connect, straight, spec)
        second = _train(connect, killed, spec, MUSTER_KILL_AT=str(at))
        echo(f"straight: {first['run']}")
        echo(f"killed:   {second['run']}, {_restart(connect(), second, at)}")
        code = _compare(connect(), loaded, spec, first["run"], second["run"])
    raise typer.Exit(code)


def _pair(spec: Spec, source: str, at: int, iterations: int | None) -> tuple[Spec, Spec]:
    """The specs of the uninterrupted and the killed run. Raises SpecError."""
    if spec.train is None:
        raise SpecError(f"{source}: verify-resume needs a job that trains; this is a {spec.kind} job")
    if at < 1:
        raise SpecError(f"--at {at}: expected an iteration, from 1")
    after = at if iterations is None else iterations
    if after < 1:
        raise SpecError(
            f"--iterations {after}: at least one iteration must follow --at {at}, or nothing can be resumed"
        )
    changes: dict[str, Any] = {
        "train": spec.train.model_copy(update={"iterations": at + after}),
        "nodes": spec.nodes.model_copy(update={"min": spec.nodes.max}),
        "on_child_failure": "restart",
        "evaluation": None,  # separate jobs that the comparison doesn't need
    }
    attempts = max(2, spec.retry.attempts)
    # a restart would interrupt the uninterrupted run
    straight = {"name": f"{spec.name[:80]}-straight", "retry": Retry(attempts=1)}
    killed = {"name": f"{spec.name[:80]}-killed", "retry": Retry(attempts=attempts)}
    return spec.model_copy(update=changes | straight), spec.model_copy(update=changes | killed)


def _notes(spec: Spec, at: int) -> list[str]:
    """Notes on this verification before it runs."""
    notes, every = [], spec.checkpoint.every
    if isinstance(every, int) and every >= at:
        notes.append(
            f"note: checkpoint.every is {every}, so there is no checkpoint before iteration {at} ends: "
            "the restart begins at iteration 0"
        )
    if spec.nodes.min != spec.nodes.max:
        notes.append(
            f"note: both runs take {counted(spec.nodes.max, 'node')}; another number of ranks adds in another order"
        )
    if spec.resources.gpus:
        notes.append("note: GPUs add in no fixed order, so a difference in the last bits is not a defect there")
    return notes


def _train(connect: Connect, spec: Spec, source: str, **environment: str) -> dict[str, Any]:
    """Run one training to its end; returns the job's detail. Raises typer.Exit if it does not succeed."""
    client = connect()
    job = submit_spec(client, spec, source, environment)["jobId"]
    if code := see_through(client, job):
        raise typer.Exit(code)
    detail: dict[str, Any] = connect().get(f"/api/jobs/{job}")
    return detail


def _restart(client: Client, detail: dict[str, Any], at: int) -> str:
    """The end of the killed run and the iteration from which it resumed, in words. Raises typer.Exit if it was not killed as requested."""
    ended = detail["attempts"][0]["nodes"][0].get("reason", "")
    if len(detail["attempts"]) < 2 or "SIGKILL" not in ended:
        echo(f"the main rank was not killed after iteration {at} ({ended or 'no reason'}): nothing is proven")
        raise typer.Exit(1)
    log = "\n".join(line["text"] for line in client.logs(detail["id"], attempt=2, rank=0))
    found = re.search(r"resumed from checkpoint (\d{8})-", log)
    return f"by SIGKILL after iteration {at}; it resumed from iteration {int(found[1]) if found else 0}"


def _compare(client: Client, spec: Spec, source: str, first: str, second: str) -> int:
    """Compare both runs in a job, which has torch. Prints its output; returns the exit code."""
    comparison = Spec(
        name=f"{spec.name[:80]}-compare",
        queue=spec.queue,
        image=spec.image,
        resources=Resources(cpus=min(1.0, spec.resources.cpus), memory=spec.resources.memory),
        command=["python", "-P", "-m", "worker.bitwise_diff", first, second],
        retry=Retry(attempts=1),
    )
    job = submit_spec(client, comparison, source)["jobId"]
    for line in client.logs(job, follow=True):
        if line["rank"] is not None:
            echo(line["text"])
    detail = client.get(f"/api/jobs/{job}")
    if detail["status"] == "SUCCEEDED":
        return 0
    if not detail["attempts"] or detail["attempts"][-1]["exitCode"] != 1:
        echo(f"the comparison failed: {detail['statusReason']}")
    return 1
