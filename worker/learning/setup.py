"""The setup of a training: this rank's worlds, the gang's number of worlds, and their description in checkpoints."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
import warp
from tensordict import TensorDict

from shared_store.contract.documents import DocumentError
from shared_store.contract.phases import Phase
from shared_store.contract.policy import Contract, read
from shared_store.contract.policy_changes import brief, differences, robot_changes
from shared_store.volume.checkpoints import Checkpoint
from shared_store.volume.epoch import check_epoch
from shared_store.volume.files import read_json, write_json
from worker.kernels.warm_start import compile_kernels, cores, is_warm
from worker.learning.algorithm import Algorithm, ExportedPolicy, LearningSetting, Spaces, Transition, WorldShare
from worker.learning.algorithms import refuse_incomplete
from worker.learning.distributed import Gang
from worker.learning.job import Job, user_errors
from worker.learning.reporter import Beacon, CompilerProgress
from worker.settings.errors import UserError
from worker.simulation.robot_values import shown_value
from worker.tasks.run.adapting import begin_evaluation
from worker.tasks.run.mistakes import task_mistakes
from worker.tasks.run.policy_contract import policy_contract, robots_of, same_policy

if TYPE_CHECKING:
    from worker.learning.training import Training
    from worker.settings.task import TaskConfig
    from worker.tasks.run.task import Task


def build_task(
    task_type: type[Task], config: TaskConfig, share: WorldShare, gang: Gang, seed: int, beacon: Beacon | None = None
) -> Task:
    """This rank's worlds. Where its cache is cold, one rank compiles the kernels first, beside each other.

    Args:
        task_type: The task.
        config: Its configuration.
        share: The worlds of this rank.
        gang: The ranks.
        seed: Of the worlds.
        beacon: Where the phase is reported.

    Raises:
        UserError: A setting is refused, or the user's own code has a mistake.
        TrainingError: Kernels can't be written to the cache.
    """
    warp.config.log_level = warp.LOG_WARNING  # not a line for each of dozens of kernel modules
    name = f"{task_type.__module__}:{task_type.__qualname__}"
    with user_errors(), task_mistakes(name):
        with gang.in_turn("task"):
            is_first = gang.placement.local_rank == 0  # of its node, whose others would print the same
            if not is_warm(task_type, gang.device, partial(print, flush=True) if is_first else lambda _: None):
                report = CompilerProgress(beacon, is_printed=gang.is_main)
                draws = os.environ.get("MUSTER_PICTURE") != "0"
                compile_kernels(task_type, config, gang.device, cores(), report, has_picture=draws)
        if beacon is not None:
            beacon.enter(Phase.BUILDING)
        return task_type(config, share.count, seed=seed, first_world=share.first, device=gang.device)


def load_kernels(algorithm: type[Algorithm], gang: Gang) -> None:
    """Compile the algorithm's own Warp kernels once per cache, or load them from it. All ranks call it."""
    with gang.in_turn("algorithm"):
        for module in getattr(algorithm, "kernels", ()):
            warp.load_module(module, gang.device)


def total_worlds(job: Job, gang: Gang) -> int:
    """Number of worlds of the whole gang, a constant of the run that does not depend on the current number of ranks.

    ``train.worlds`` is each rank's share in a gang of full size; a resumed run has the worlds of its checkpoint.
    """
    if total := os.environ.get("MUSTER_WORLDS"):
        if not total.isdecimal() or int(total) < gang.size:
            raise UserError(f"MUSTER_WORLDS is {total!r}; expected a number of worlds, at least one for each rank")
        return int(total)
    nodes = job.spec.get("nodes")
    full = nodes["max"] * gang.placement.local_world_size if isinstance(nodes, dict) else gang.size
    return job.setting("worlds", 256) * max(full, gang.size)


def spaces_of(task: Task) -> Spaces:
    """Shapes of the observations and actions of the task's policies."""
    shapes = {name: tuple(tensor.shape[1:]) for name, tensor in task.groups.items()}
    return Spaces(shapes, task.action_size, task.discrete)


def spaces_from(policy: dict[str, Any]) -> Spaces:
    """The spaces that :func:`describe` wrote into a manifest."""
    groups = {name: tuple(shape) for name, shape in policy["groups"].items()}
    return Spaces(groups, policy["action_size"], policy.get("discrete", False))


def build_algorithm(
    algorithm: type[Algorithm],
    settings: Any,
    task: Task,
    share: WorldShare,
    gang: Gang,
    seed: int,
    *,
    rehearsal: bool = False,
) -> Algorithm:
    """Build the algorithm. Raises UserError for settings that it refuses, and for a class that is not a complete algorithm. All ranks
    call it.

    Args:
        rehearsal: See :attr:`LearningSetting.rehearsal`.
    """
    load_kernels(algorithm, gang)
    interface = None if task.discrete else task.interface()
    ranges = tuple(action.clip for action in interface.actions) if interface else ()
    setting = LearningSetting(
        spaces_of(task), share, gang, seed, 1.0 / task.config.control_hz, ranges, rehearsal=rehearsal
    )
    with user_errors("train"):
        built = algorithm(settings, setting)
    refuse_incomplete(built, algorithm.__name__, ("steps", "graphs"))
    return built


def observed(task: Task) -> TensorDict:
    """The task's observation groups, live, batch size (worlds,)."""
    return TensorDict(task.groups, [task.world_count], device=task.device)


def transition(task: Task) -> Transition:
    """Live views of the result of the task's last step."""
    ended = TensorDict(task.terminal_groups, [task.world_count], device=task.device)
    return Transition(observed(task), ended, task.rewards, task.dones, task.time_outs)


def described_policy(training: Training, task: Task) -> ExportedPolicy | None:
    """The policy of this training in its exported form, with new weights; None, with a warning, if its algorithm fails to make one.

    The state of torch's generator is restored, since weights are drawn from it.
    """
    with torch.random.fork_rng(devices=[]):
        try:
            return training.algorithm_type.build_policy(training.settings, spaces_of(task), "cpu").module()
        except Exception as error:  # of a user's own class: training continues, and the export will report it again
            what = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            print(f"warning: algorithm {training.algorithm} gives no policy that could be exported: {what}", flush=True)
            return None


def describe(training: Training, task: Task, exported: ExportedPolicy | None = None) -> dict[str, Any]:
    """The entries of a checkpoint's manifest about its policy, for evaluation and export without the job.

    Args:
        training: The training.
        task: Its task, with worlds.
        exported: See :func:`worker.tasks.run.policy_contract.policy_contract`.
    """
    spaces, name = spaces_of(task), training.job.section["task"]
    return {
        "task": name,
        "train": training.job.section,
        "algorithm": training.algorithm,
        "settings": dataclasses.asdict(training.settings),
        "policy": {
            "action_size": task.action_size,
            "groups": {name: list(shape) for name, shape in spaces.observations.items()},
            **({"discrete": True} if spaces.discrete else {}),
        },
        "contract": policy_contract(task, name, exported).document(),
        "torch": torch.__version__,
    }


def write_contract(job: Job, document: dict[str, Any]) -> None:
    """Write the run's ``contract.json`` if it is missing or differs. Main rank only.

    A full volume does not end training, since every checkpoint has the contract too. Raises StaleEpoch.
    """
    check_epoch(job.run, job.epoch)
    try:
        job.run.path.stat()  # where the run is not, the volume is another one
        if read_json(job.run.contract) != document:
            write_json(job.run.contract, document)
    except (OSError, ValueError) as error:
        print(f"warning: the policy contract could not be written ({error}); checkpoints have it", flush=True)


def contract_from(facts: Mapping[str, Any], checkpoint: str) -> Contract | None:
    """The policy contract in a checkpoint's manifest; None if an older version wrote it. Raises UserError if it can't be read."""
    if "contract" not in facts:
        return None
    try:
        return read(facts["contract"], f"checkpoint {checkpoint}: contract")
    except DocumentError as error:
        raise UserError(str(error)) from None


def begin_as_trained(task: Task, checkpoint: Checkpoint) -> None:
    """Prepare worlds for a checkpoint's policy: set curricula and adaptive numbers as in its training."""
    facts = checkpoint.manifest
    last = max(0, checkpoint.iteration - 1), facts.get("reward"), facts.get("episode_length")
    begin_evaluation(task, *last, facts.get("adaptive_steps", {}))


def check_robots(then: Contract | None, task: Task, of: str, *, accept: bool) -> str:
    """Compare the task's robots with those of a policy's training.

    A contract of an older Muster knows no robots. Then a robot changed if Newton's importer, which nothing judged, reads it otherwise.

    Args:
        then: The policy's contract; None: of an older Muster.
        task: Its task, as it is now.
        of: The owner of the contract: ``"checkpoint 00000100-e1"``.
        accept: Whether changed robots are accepted.

    Returns:
        The changes that are accepted, in a sentence; empty without any.

    Raises:
        UserError: A robot changed, and that is not accepted.
    """
    if then is not None and then.robots:
        lines = robot_changes(then.robots, robots_of(task))
    else:
        lines = []
        for name, reading in task.readings.items():
            for each in reading.corrected:
                if not each.is_rounding:
                    was, is_now = shown_value(each.built), shown_value(each.file)
                    lines.append(f"{name}: {each.element}: {each.field} was {was}, is {is_now}")
    if not lines:
        return ""
    what = f"{of} was trained on another robot than the file gives now: {brief(lines)}"
    if not accept:
        raise UserError(
            f"{what}; to go on all the same, add --accept-changed-robot (accept_changed_robot: true in a job's section)"
        )
    return what


def check_contract(checkpoint: Checkpoint, task: Task, section: Mapping[str, Any]) -> str:
    """Check that a checkpoint's policy can act in the task as it is now.

    For a checkpoint without a contract, only sizes are compared.

    Args:
        checkpoint: The checkpoint.
        task: Its task, with worlds.
        section: The job's section, which may accept a changed robot.

    Returns:
        The robots' changes that are accepted and were printed, in a sentence; empty without any.

    Raises:
        UserError: The meaning of the task's observations, actions or commands changed since the training, or its robot did.
    """
    facts, of = checkpoint.manifest, f"checkpoint {checkpoint.name}"
    name, then = facts["task"], contract_from(facts, checkpoint.name)
    changes = check_robots(then, task, of, accept=bool(section.get("accept_changed_robot")))
    if then:
        changes = check_fit(then, same_policy(policy_contract(task, name), then), of, changes)
    elif (had := spaces_from(facts["policy"])) != (has := spaces_of(task)):
        raise UserError(f"{of} does not fit task {name} as it is now: it had {had}, it has {has}")
    if changes:
        print(f"warning: {changes}", flush=True)
    return changes


def check_fit(then: Contract, now: Contract, of: str, changes: str) -> str:
    """Check that a policy means the same in its task as it is now.

    Args:
        then: The policy's contract.
        now: That of the task as it is now.
        of: The owner of the policy: ``"checkpoint 00000100-e1"``.
        changes: Accepted changes of the robots, in a sentence: values that may follow from them may differ. Empty without any.

    Returns:
        ``changes``, and such values.

    Raises:
        UserError: The meaning of the observations, actions or commands changed.
    """
    if lines := differences(then, now, of_robot=not changes):
        raise UserError(
            f"{of} does not fit task {then.task} as it is now: {brief(lines)}; use the task's code of that time"
        )
    follows = differences(then, now)
    return f"{changes}; {brief(follows)}" if follows else changes
