"""``python -m worker.repeat_incident FILE [--device cuda:0]``: do an iteration again in which worlds failed.

A run that stops for that reason leaves ``FILE`` in its ``incidents/`` directory: the worlds as they were when the iteration began, and
every action. Shown are the first worlds that go wrong, the step, what was wrong, the joint state before that step, and, where the reward
was not finite, each of its terms. Exits 0 where it happened again, 1 where it did not, 2 where the file can't be read.
"""

from __future__ import annotations

import argparse
import pickle
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shared_store.contract.error_text import counted
from shared_store.contract.policy import RobotModel
from shared_store.contract.policy_changes import brief, robot_changes
from worker.learning.job import EX_ERROR, configure, run_command, user_errors
from worker.settings.accepted_changes import CHANGED_ROBOTS
from worker.settings.errors import UserError

if TYPE_CHECKING:
    import torch

    from worker.tasks.run.task import Task

SHOWN = 10
"""At most so many steps with failed worlds are shown."""


def load(path: Path, device: str) -> tuple[Task, dict[str, Any]]:
    """The task as it was when the iteration began, and the file's content. Raises UserError for any other file."""
    import torch

    from worker.tasks import find_task

    try:
        content = torch.load(path, weights_only=True)
        section = content["train"]
    except OSError as error:
        raise UserError(f"{path} can't be read ({error.strerror})") from error
    except (EOFError, pickle.UnpicklingError, RuntimeError, KeyError, TypeError) as error:
        raise UserError(f"{path} holds no incident of a training") from error
    if Path(content["directory"]).is_dir():
        sys.path.append(content["directory"])  # where a task of the user's own was found
    CHANGED_ROBOTS.set(bool(section.get("accept_changed_robot")))
    with user_errors(str(path)):
        task_type = find_task(section["task"])
        if warp := sys.modules.get("warp"):
            warp.config.log_level = warp.LOG_WARNING  # not a line for each kernel module
        task = task_type(
            configure(task_type, section),
            content["worlds"],
            seed=content["seed"],
            first_world=content["first_world"],
            device=device,
        )
        _compare_robots(content.get("robots", ()), task)
        state, own = content["state"], task.state_tensors().get("world_factors")
        if own is not None and torch.allclose(state["world_factors"], own.cpu(), rtol=1e-5):
            state["world_factors"] = own.cpu()  # drawn anew, on another device with other last digits
        task.load_state_dict(state)
    task.take_counts(content.get("others", {}))  # files of older versions have none
    task.begin_iteration(*content["began"])
    task.clear_statistics()
    return task, content


def _compare_robots(then: Sequence[Mapping[str, Any]], task: Task) -> None:
    """Print which robots load otherwise than in the training; files of older versions know none."""
    from worker.tasks.run.policy_contract import robots_of

    if lines := robot_changes([RobotModel(**each) for each in then], robots_of(task)):
        print(
            f"warning: it happened to another robot than the file gives now: {brief(lines)}; restore the file",
            flush=True,
        )


def repeat(path: Path, device: str) -> int:
    """Step through the iteration; the exit code."""
    task, content = load(path, device)
    actions = content["actions"].to(task.device)
    print(
        f"iteration {content['iteration']} of {content['train']['task']}: {counted(len(actions), 'step')} of {counted(task.world_count, 'world')}"
    )
    found = 0
    for step, action in enumerate(actions):
        state = {name: tensor.cpu().clone() for name, tensor in task.state_tensors().items()}
        task.step(action)
        failed_world = task.read_failed_world(int(task.failed_world))
        if failed_world is None:
            continue
        found += 1
        world, cause = failed_world
        print(f"step {step + 1}: world {content['first_world'] + world}: {cause}; before it:")
        for name in (name for name in state if name.startswith("joint")):
            print(f"  {name}: {[round(value, 6) for value in state[name].view(task.world_count, -1)[world].tolist()]}")
        print(f"  action: {[round(value, 6) for value in action[world].tolist()]}")
        if terms := _terms_of_step(task, world, state["episode_sums"]):
            print(f"  reward terms of the step: {terms}")
        task.clear_statistics()
        if found == SHOWN:
            print(f"(the first {SHOWN} such steps)")
            break
    print("it happened again" if found else "nothing failed: on another device the last digits differ")
    return 0 if found else EX_ERROR


def _terms_of_step(task: Task, world: int, sums: torch.Tensor) -> str:
    """The weighted reward terms of a world's last step, with their names; empty where their sum is finite.

    Args:
        task: The task, after the step that ended the world's episode.
        world: Index of the world.
        sums: The sums of all running episodes before the step, shape ``(worlds, 2 + terms)``.
    """
    from worker.simulation.episodes import TERMS

    columns = slice(int(TERMS), int(TERMS) + len(task.reward_terms))
    values = task.ended.sums[world, columns].cpu() - sums[world, columns]
    if values.sum().isfinite():
        return ""
    return ", ".join(f"{name} {value:g}" for name, value in zip(task.reward_terms, values.tolist(), strict=True))


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--device", default="cpu", help='"cpu" or "cuda:<n>"')
    options = parser.parse_args()
    return repeat(options.file, options.device)


if __name__ == "__main__":
    run_command(main)
