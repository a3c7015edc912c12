"""The initial weights of a run: those of a clone's parent, which it adopts, and those of a teacher, whom its algorithm imitates.

A clone's are in its own directory (:mod:`shared_store.volume.initial_weights`).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import torch

from shared_store.contract.policy_changes import brief, differences, robot_changes
from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint
from shared_store.volume.files import DamagedFile
from shared_store.volume.initial_weights import parent_checkpoint
from shared_store.volume.run_settings import changed_setting
from worker.learning.algorithm import Algorithm, Student
from worker.learning.algorithms import section_of
from worker.learning.distributed import Gang
from worker.learning.job import Job, user_errors
from worker.learning.setup import contract_from
from worker.learning.shards import read_file
from worker.learning.trained import choose_checkpoint, chosen_by_main
from worker.settings.errors import UserError


def adopt(job: Job, gang: Gang, algorithm: Algorithm, facts: Mapping[str, Any]) -> Checkpoint | None:
    """Load the run's initial weights into ``algorithm``; None if the run begins with new ones. All ranks call it.

    Args:
        job: The job, whose run has no checkpoint of its own yet.
        gang: The ranks.
        algorithm: Receives networks and normalisers; its optimizer stays new.
        facts: Entries of this job's manifests on task, algorithm and policy.

    Raises:
        UserError: The weights are missing, damaged or do not fit; the message names the differing tensor or setting.
    """

    def choose() -> Checkpoint | None:
        if (found := parent_checkpoint(job.run)) is None and job.parent:
            raise DamagedCheckpoint("run.json does not name them: the run was deleted before it began")
        return found

    errors = DamagedCheckpoint, DamagedFile, OSError
    checkpoint, problem = chosen_by_main(gang, job.run.parent, choose, errors)
    if problem:
        raise UserError(
            f"run {job.run.name} can't begin with the weights of {job.parent or 'its parent'}: {problem}; clone it again under another name"
        )
    if checkpoint is None:
        return None
    learnt: Any = read_file(checkpoint, "learner.pt", gang.device).get("algorithm")
    saved, here = checkpoint.manifest, json.loads(json.dumps(facts))
    _check_settings(checkpoint, here, algorithm)
    try:
        algorithm.load_state_dict(learnt, weights_only=True)
    except (RuntimeError, ValueError, KeyError, TypeError, AttributeError) as error:
        why = _difference(algorithm.state_dict(), learnt) or " ".join(str(error).split())[:300]
        raise UserError(
            f"the weights of checkpoint {checkpoint.name} do not fit this job: {why}{_context(saved, here)}"
        ) from error
    then, now = (contract_from(facts, checkpoint.name) for facts in (saved, here))
    if gang.is_main and then and now:
        if lines := differences(then, now, ranges=True):
            print(f"warning: the weights were learnt with another policy contract: {brief(lines)}", flush=True)
        if lines := robot_changes(then.robots, now.robots):
            print(
                f"warning: the weights were learnt on another robot than the file gives now: {brief(lines)}", flush=True
            )
    return checkpoint


def load_teacher(job: Job, gang: Gang, algorithm: Algorithm, adopted: Checkpoint | None) -> None:
    """Load the weights of the teacher that a new run's settings name (:class:`worker.learning.algorithm.Student`). All ranks call it.

    Args:
        job: The job, in the same store as the teacher's run.
        gang: The ranks.
        algorithm: The algorithm, with or without a teacher.
        adopted: The checkpoint with the run's initial weights; if it was made with the same teacher, it holds the teacher.

    Raises:
        UserError: The checkpoint does not exist, is of an older Muster, or its weights do not fit.
    """
    if not isinstance(algorithm, Student) or not (reference := algorithm.teacher_checkpoint):
        return
    if adopted and (adopted.manifest.get("settings") or {}).get("teacher_checkpoint") == reference:
        return
    name, _, iteration = reference.partition("@")
    copy = job.run.teacher(name)  # chosen when the job was submitted, unless the teacher's run did not exist yet
    is_copied = gang.broadcast_text("copied" if copy.checkpoints.is_dir() else None)
    checkpoint = choose_checkpoint(gang, copy if is_copied else job.store.run(name), iteration or None)
    if "algorithm" not in checkpoint.manifest:
        raise UserError(
            f"teacher_checkpoint: checkpoint {checkpoint.name} of run {name} is of an older Muster, which knew no algorithms; "
            "train the teacher again"
        )
    learnt = read_file(checkpoint, "learner.pt", gang.device)["algorithm"]
    with user_errors("train"):
        algorithm.load_teacher(learnt)


def _check_settings(checkpoint: Checkpoint, here: Mapping[str, Any], algorithm: Algorithm) -> None:
    """Check settings whose difference tensors would not show, or only in many lines. Raises UserError with the first difference."""
    manifest = checkpoint.manifest
    if (learnt := manifest.get("algorithm")) != here["algorithm"]:
        if not any(":" in str(name) for name in (learnt, here["algorithm"])):
            raise UserError(
                f"the weights of checkpoint {checkpoint.name} are of algorithm {learnt}, which {here['algorithm']} can't read; set "
                f"train.algorithm: {learnt}, or a module:Class of your own whose load_state_dict reads them"
            )
        return  # whether a class of the user's own reads the other's, or is read, only the loading shows
    saved = manifest.get("settings") or {}
    if changed := changed_setting(algorithm.config_type, saved, here["settings"], saved, of_clone=True):
        key, old, new, _ = changed
        raise UserError(
            f"the weights of checkpoint {checkpoint.name} do not fit this job: {section_of(here['algorithm'])}.{key} is {old!r} "
            f"there and {new!r} here; leave the setting as it is there"
        )


def _context(saved: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """The differences in algorithm or in the policy's inputs and outputs, as text; empty without any."""
    if saved.get("algorithm") != here["algorithm"]:
        return f"; they are of algorithm {saved.get('algorithm')}, and {here['algorithm']} does not read them"
    spaces = []
    for facts in (saved, here):
        policy = facts.get("policy") or {}
        groups = ", ".join(f"{name} {shape}" for name, shape in sorted((policy.get("groups") or {}).items()))
        spaces.append(f"observations {groups} and {policy.get('action_size')} actions")
    tasks = [f"(task {facts.get('task')})" for facts in (saved, here)]
    return "" if spaces[0] == spaces[1] else f"; there {spaces[0]} {tasks[0]}, here {spaces[1]} {tasks[1]}"


def _difference(own: Any, saved: Any) -> str:
    """The first tensor of the networks that is missing on one side or has another shape; empty without any."""
    if not isinstance(saved, Mapping):
        return f"it holds a {type(saved).__name__} where the state of an algorithm is expected"
    here, theirs = (dict(_shapes(each)) for each in (own, saved))
    for name in here:
        if name in theirs and theirs[name] != here[name]:
            return f"{name} has shape {theirs[name]} there and {here[name]} here"
    if missing := [name for name in here if name not in theirs]:
        return f"{missing[0]} is not there"
    return next((f"{name} is there, and this job's algorithm has none" for name in theirs if name not in here), "")


def _shapes(state: Any, path: str = "") -> Iterator[tuple[str, tuple[int, ...]]]:
    """Name and shape of every tensor outside the optimizers."""
    if isinstance(state, torch.Tensor):
        yield path, tuple(state.shape)
    items = state.items() if isinstance(state, Mapping) else enumerate(state) if isinstance(state, list | tuple) else ()
    for name, value in items:
        if "optimizer" not in str(name):
            yield from _shapes(value, f"{path}.{name}" if path else str(name))
