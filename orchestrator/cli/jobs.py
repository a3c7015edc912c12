"""``muster submit``, ``show``, ``stop``, ``schema``."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from orchestrator.cli.plans import show_plan
from orchestrator.cli.progress import best_told, follow, shown_metrics
from orchestrator.cli.terminal import Console, echo, echo_json, one_line
from orchestrator.client import Client, named
from orchestrator.domain.errors import SpecError
from orchestrator.domain.hosts import engine_of
from orchestrator.domain.job import TERMINAL
from orchestrator.engines.installed import ENGINES, traits_of
from orchestrator.spec import file as specfile
from orchestrator.spec.compile import compile_definition, compile_submission
from orchestrator.spec.json_schema import contract_schema, schema
from orchestrator.spec.model import Spec
from shared_store.evaluations import in_one_line
from shared_store.metrics import finite, warnings_of
from shared_store.wording import counted, nearest

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for scripts.")]
AcceptOption = Annotated[
    bool,
    typer.Option(
        "--accept-changed-robot", help="Go on where the robot's file loads otherwise than in the policy's training."
    ),
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="Change a key of the spec: train.iterations=600. Repeatable.")
]
SpecArgument = Annotated[str, typer.Argument(help="A job YAML, such as job_specs/cartpole.yaml.")]
JobArgument = Annotated[
    str,
    typer.Argument(
        help="Job id or its first letters (4 or more), or a job name (its newest job); with :INDEX, an array's child."
    ),
]

_EXAMPLES = """Examples:  muster submit job_specs/ant.yaml --set train.iterations=600 -f
muster submit job_specs/ant.yaml --name ant-2 --set train.seed=2 --dry-run"""
_PATIENCE = 3.0
"""Seconds after which a slow stop explains itself."""
_OF_RUN = {
    "evaluate": "evaluates",
    "race": "races",
    "export": "exports",
    "record": "records",
    "render": "renders",
}
"""Verb for what a job of each kind does with another run."""
COLOURS = {"SUCCEEDED": "green", "FAILED": "red", "RUNNING": "cyan", "STARTING": "cyan", "RUNNABLE": "yellow"}


def register(app: typer.Typer) -> None:
    app.command(epilog=_EXAMPLES)(submit)
    app.command(epilog="Example:  muster show ant")(show)
    app.command(epilog="Example:  muster stop ant   then   muster resume RUN")(stop)
    app.command(epilog="Example:  muster checkpoint ant")(checkpoint)
    app.command(epilog="Example:  muster stacks ant > stacks.txt")(stacks)
    app.command("schema", epilog="Example:  muster schema > muster.schema.json     or:  muster schema --contract")(
        print_schema
    )


def submit_spec(
    client: Client, spec: Spec, source: str, environment: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Register and submit a spec; refused before anything is registered if no host could ever hold it. Raises SpecError.

    ``environment`` is added on every node.
    """
    definition = compile_definition(spec, os.getcwd())
    if problem := client.post("/api/fit", {"definition": definition, "queue": spec.queue})["problem"]:
        if problem.startswith("evaluation: "):
            raise SpecError(f"{source}: {problem}; change evaluation.resources or evaluation.queue")
        lower = "lower nodes or resources (cpus may be a fraction)"
        if spec.train and spec.resources.gpus:
            lower += "; resources.gpus=0 and train.worlds=16 try it on CPUs, slowly"
        raise SpecError(f"{source}: resources: {problem}; {lower}")
    registered = client.batch("RegisterJobDefinition", **definition)
    return client.batch("SubmitJob", **compile_submission(spec, registered["jobDefinitionArn"], environment))


def submit(
    spec: SpecArgument,
    set_: SetOption = None,
    follow_: Annotated[bool, typer.Option("--follow", "-f", help="Show progress until the job ends.")] = False,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Show what would start where, without starting it; --json: with all variables."),
    ] = False,
    engine: Annotated[
        str | None,
        typer.Option(help=f"Engine that runs the job, one of the controller's: {', '.join(ENGINES)}."),
    ] = None,
    name: Annotated[str | None, typer.Option(help="Of the job, and of its run, instead of the spec's.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Submit a job to a running controller."""
    loaded = specfile.load(spec, [*(set_ or ()), *called(set_, name)])
    tell(loaded)
    with Client.connect() as client:
        if engine is not None:
            loaded = on_engine(client, loaded, engine, spec)
        if dry_run:
            show_plan(client, compile_definition(loaded, os.getcwd()), loaded.queue, as_json)
            return
        submitted = submit_spec(client, loaded, spec)
        if as_json:
            echo_json(submitted)
        else:
            echo(f"submitted {submitted['jobName']} as {submitted['jobId']}")
            if not follow_:
                echo(f"follow it with: muster logs {submitted['jobId'][:8]} -f")
        if follow_:
            raise typer.Exit(follow(client, submitted["jobId"]))


def tell(spec: Spec) -> None:
    """Print a spec's warnings on standard error."""
    for note in spec.notes:
        echo(f"note: {one_line(note)}", err=True)


def on_engine(client: Client, spec: Spec, engine: str, source: str) -> Spec:
    """The same spec for the queue of that engine. Raises SpecError if the controller lacks it."""
    queue = engine_queue(client, engine)
    if spec.queue not in ("default", queue):
        raise SpecError(f"{source}: queue: {spec.queue}, but --engine {engine} means {queue}; leave one of them out")
    return spec.model_copy(update={"queue": queue})


def engine_queue(client: Client, engine: str) -> str:
    """The queue of an engine. Raises SpecError if the controller lacks it."""
    check_engine(engine)
    queues: dict[str, str] = client.get("/api/capacity")["engines"]
    if engine not in queues:
        raise SpecError(
            f"--engine {engine}: the controller has {', '.join(queues)}; start it with: muster serve "
            + " ".join(f"--engine {name}" for name in (*queues, engine))
        )
    return queues[engine]


def on_queue(changes: Sequence[str] | None, queue: str | None) -> list[str]:
    """The change that sends a job to ``queue``. Raises SpecError if ``changes`` name a queue too."""
    if queue is None:
        return []
    for change in changes or ():
        if change.partition("=")[0] == "queue":
            raise SpecError(f"--set {change}: --queue or --engine sets the queue ({queue}); give one of them")
    return [f"queue={json.dumps(queue)}"]


def called(changes: Sequence[str] | None, name: str | None) -> list[str]:
    """The change that names a job. Raises SpecError where ``changes`` do, too."""
    if name is None:
        return []
    if twice := next((each for each in changes or () if each.partition("=")[0] == "name"), None):
        raise SpecError(f"--set {twice}: --name {name} names the job; give one of them")
    return [f"name={json.dumps(name)}"]


def check_engine(name: str) -> None:
    """Raises SpecError for a name that no engine has."""
    if name not in ENGINES:
        raise SpecError(f"--engine {name}: there is no such engine; {nearest(name, ENGINES)}")


def _counted(summary: dict[str, int]) -> str:
    """The children of an array by state."""
    return ", ".join(f"{count} {status}" for status, count in summary.items() if count)


def _used(attempt: dict[str, Any], saves: bool) -> str:
    """GPU time of an attempt (CPU time without GPUs), and the lost part if known, which only a job that ``saves`` has."""
    kind = "Gpu" if attempt["gpuSeconds"] else "Cpu"
    used, lost = attempt[f"{kind.lower()}Seconds"], attempt[f"wasted{kind}Seconds"]
    if not used:
        return ""
    return f", {used:.0f} {kind.upper()}-seconds" + (f", {lost:.0f} of them lost" if saves and lost >= 1 else "")


def _gpus(node: dict[str, Any]) -> str:
    """The GPUs of a node, or their number if only its engine knows them."""
    if not node["gpus"]:
        return ""
    known = node.get("devices") or (node["gpus"] if traits_of(engine_of(node["host"])).gpu_ids else None)
    if known:
        return f", GPUs {','.join(known)}"
    return f", {counted(len(node['gpus']), 'GPU')}"


def show(job: JobArgument, as_json: JsonOption = False) -> None:
    """Show a job: its state and the reason, its attempts and nodes, its run and results."""
    with Client.connect() as client:
        detail = client.get(f"/api/jobs/{named(job)}")
        detail["job"] = client.batch("DescribeJobs", jobs=[detail["id"]])["jobs"][0]
    if as_json:
        echo_json(detail, indent=1)
        return
    console = Console(highlight=False, soft_wrap=True)
    colour = COLOURS.get(detail["status"], "white")
    console.print(f"[bold]{detail['name']}[/]  {detail['id']}  [{colour}]{detail['status']}[/]")
    facts = {
        "why": "" if detail["status"] == "SUCCEEDED" else one_line(detail["statusReason"] or ""),
        "created": when(detail["createdAt"]),
        "took": took(next((a["startedAt"] for a in detail["attempts"] if a["startedAt"]), None), detail["stoppedAt"]),
        "queue": detail["queue"] + (f", share {detail['share']}" if detail["share"] else ""),
        "run": detail["run"] + (" (gone; another run has its name now)" if detail["runIsReplaced"] else ""),
        "store": one_line(detail.get("storeProblem") or ""),
        _OF_RUN.get(detail["kind"], ""): _source(detail),
        "started from": started_from((detail["results"] or {}).get("parent")),
        "definition": detail["job"]["jobDefinition"].rpartition("/")[2],
    }
    results = detail["results"] or {}
    array = detail["job"].get("arrayProperties", {})
    if "statusSummary" in array:  # the children have runs and nodes, not the array
        facts["run"] = None
        facts["children"] = f"{array['size']}: {_counted(array['statusSummary'])}; muster show {detail['id'][:8]}:0"
    if progress := detail["progress"]:
        total = ((detail["spec"] or {}).get("train") or {}).get("iterations", "?")
        shown = shown_metrics(progress).replace("  ", ", ")
        facts["progress"] = (
            f"iteration {progress['iteration']} of {total}, reward {_number(progress.get('reward'))}{shown}"
        )
        facts["learning"] = _learning(progress)
        facts["warning"] = "; ".join(map(one_line, warnings_of(progress)))
    if evaluation := results.get("evaluation"):
        facts["evaluation"] = in_one_line(evaluation)
    facts["best"] = best_told(detail["run"], results.get("best"))
    facts["evaluating"] = _automatic(detail["run"], results.get("automatic"))
    facts |= {name: results.get(name) for name in ("checkpoint", "plot", "picture")} | {
        "directory": results.get("path")
    }
    for name, value in facts.items():
        if value:
            console.print(f"  {name + ':':13} {value}", markup=False)
    spent = 0
    for attempt in detail["attempts"]:
        started = attempt["startedAt"] is not None
        ended = attempt["ending"] or ("running" if started else "is being started")
        counted = "" if attempt["spent"] else ", not counted"
        spent += bool(attempt["spent"])
        number = f"{attempt['number']} of {detail['attemptsAllowed']}"
        if spent < attempt["number"]:  # attempts that exited on request don't count against the allowed number
            number = f"{attempt['number']} ({spent} of {detail['attemptsAllowed']} spent)"
        reason = f": {one_line(attempt['statusReason'])}" if attempt["statusReason"] and ended != "succeeded" else ""
        lasted = took(attempt["startedAt"], attempt["stoppedAt"])
        console.print(
            f"  attempt {number} (epoch {attempt['epoch']}, {lasted}{_used(attempt, detail['kind'] == 'train')}) {ended}{counted}{reason}",
            markup=False,
        )
        for node in attempt["nodes"]:
            state = "running" if started else "not started yet"
            if not node["running"]:
                code = f"exit {node.get('exitCode', '?')}"
                state = f"{code}: {one_line(node.get('reason', '')).removeprefix(f'{code}, ')}"
            where = f"{node['host']}{_gpus(node)}"
            console.print(f"    node {node['index']}  {node.get('address', '-')} on {where}  {state}", markup=False)
            if node["log"]:  # not before the attempt has its run
                console.print(f"      {node['log']}", markup=False, style="dim")


_LEARNING = {
    "action_std": "deviation",
    "kl": "KL",
    "explained_variance": "explained variance",
    "saturation": "saturation",
    "clip_fraction": "clip fraction",
    "gradient_norm": "gradient norm",
    "v_max_mass": "mass at v_max",
}
"""Metrics that show how a training learns, and their names."""


def _learning(record: Mapping[str, Any]) -> str:
    """How a training learns, in one line."""
    known = {word: value for name, word in _LEARNING.items() if (value := finite(record.get(name))) is not None}
    return ", ".join(f"{word} {value:.3g}" for word, value in known.items())


def _source(detail: Mapping[str, Any]) -> str:
    """The checkpoint of another run that a job reads, as ``RUN@ITERATION``."""
    section = (detail["spec"] or {}).get(detail["kind"])
    if not isinstance(section, dict) or "run" not in section:
        return ""
    return f"{section['run']}@{section.get('checkpoint', 'latest')}"


def _automatic(run: str, told: Mapping[str, Any] | None) -> str:
    """The newest automatic evaluation of a training in one line."""
    if not told:
        return ""
    parts = []
    if told["job"]:
        reason = f": {one_line(told['statusReason'] or '')}" if told["status"] not in ("SUCCEEDED", None) else ""
        parts.append(
            f"{run}@{told['iteration']} by job {told['job'][:8]}, {told['status'] or 'which can not be seen'}{reason}"
        )
    if told["passed"]:
        parts.append(f"{counted(told['passed'], 'checkpoint')} passed over for newer ones")
    if told["problem"]:
        parts.append(one_line(told["problem"]))
    return "; ".join(parts)


def started_from(parent: Mapping[str, Any] | None) -> str:
    """The source of a clone's weights, in one line; empty for other runs."""
    if not parent:
        return ""
    score = scored(parent.get("score"), parent.get("score_error"))
    told = f", score {score}" if score != "-" else ""
    return f"{parent.get('run')}@{parent.get('iteration')} (checkpoint {parent.get('checkpoint')}{told})"


def scored(score: float | None, error: float | None) -> str:
    """A score with its standard error, if known: ``812.30 ± 4.10``."""
    if score is None:
        return "-"
    return f"{score:.2f}" + (f" ± {error:.2f}" if error is not None else "")


def stop(
    job: JobArgument,
    reason: Annotated[str, typer.Option(help="Reason, kept with the job.")] = "stopped by the user",
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Return only when the job has ended.")] = True,
) -> None:
    """Stop a job: it checkpoints and exits; `muster resume` continues from there.

    A training ends its iteration first. One that does not end within the 30 s that a job has is left, and `muster resume` repeats it.
    """
    with Client.connect() as client:
        detail = client.get(f"/api/jobs/{named(job)}")
        if detail["status"] in TERMINAL:
            echo(f"{detail['name']} ({detail['id'][:8]}) is {detail['status']} already")
            return
        client.batch("TerminateJob", jobId=detail["id"], reason=reason)
        said, patience = detail["statusReason"], time.monotonic() + _PATIENCE
        slow = wait and slow_iteration(detail)
        while wait and detail["status"] not in TERMINAL:
            time.sleep(0.2)
            detail = client.get(f"/api/jobs/{detail['id']}")
            if detail["statusReason"] != said and time.monotonic() > patience:
                said = detail["statusReason"]
                echo(f"{detail['name']} ({detail['id'][:8]}): {one_line(said)}", err=True)
            if slow and time.monotonic() > patience:
                echo(slow, err=True)
                slow = ""
    if not wait:
        echo(f"{detail['name']} ({detail['id'][:8]}) is asked to stop")
        return
    echo(f"{detail['name']} ({detail['id'][:8]}) ended: {one_line(detail['statusReason'])}")
    if lost := lost_iterations(detail):
        echo(lost)
    if (detail["results"] or {}).get("checkpoint") or (detail["kind"] == "command" and detail["run"]):
        echo(f"continue with: muster resume {detail['run']}")


def slow_iteration(detail: Mapping[str, Any]) -> str:
    """A warning about the present iteration of a training whose iterations last long; empty for others."""
    seconds = (detail["progress"] or {}).get("iteration_seconds") or 0.0
    if detail["kind"] != "train" or detail["status"] != "RUNNING" or seconds < _PATIENCE:
        return ""
    return (
        f"an iteration takes about {seconds:.0f} s; one that does not end in the time that the job has to leave (30 s, unless the "
        f"engine gives less) is left, and resume repeats it; to lose none: muster checkpoint {detail['name']}, then stop"
    )


def lost_iterations(detail: Mapping[str, Any]) -> str:
    """The iterations of a stopped training that no checkpoint has; empty without any, and for other jobs."""
    done = (detail["progress"] or {}).get("iteration", 0)
    saved = (detail["results"] or {}).get("iteration", 0)
    if detail["kind"] != "train" or done <= saved:
        return ""
    return f"lost: {counted(done - saved, 'iteration')}, those after {saved} until {done}"


def checkpoint(job: JobArgument) -> None:
    """Make a training job save now; return when the checkpoint is durable."""
    with Client.connect() as client:
        answer = client.post(f"/api/jobs/{named(job)}/checkpoint", {}, seconds=180)["answer"]
    echo(answer)
    if not answer.startswith("checkpoint "):
        raise typer.Exit(1)


def stacks(job: JobArgument) -> None:
    """Print the Python and native stacks of every rank of a running job.

    The stacks go to the job's log too.
    """
    with Client.connect() as client:
        for node in client.get(f"/api/jobs/{named(job)}/stacks", seconds=180):
            echo(f"== node {node['node']}\n{node['stacks']}")


def print_schema(
    contract: Annotated[
        bool,
        typer.Option("--contract", help="Print the schema of a policy contract (contract.json) instead of a job's."),
    ] = False,
) -> None:
    """Print the JSON Schema of the job YAML, for editors, or of the policy contract."""
    echo_json(contract_schema() if contract else schema(), indent=2)


def when(milliseconds: int | None) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(milliseconds / 1000)) if milliseconds else "-"


def took(start: int | None, end: int | None) -> str:
    if not start:
        return "-"
    seconds = (
        max(0, int((end or time.time() * 1000) - start)) // 1000
    )  # this machine's clock may lag behind the controller's
    return f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
