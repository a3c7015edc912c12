"""The dry pass of a task finds what a GPU loads."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import torch
import warp as wp

from worker.kernels import making
from worker.kernels.listing import kernels_of
from worker.kernels.making import family, kept
from worker.learning.algorithms import find_algorithm
from worker.tasks import find_task

ROOT = Path(__file__).parents[4]


def test_the_list_of_a_task_holds_what_a_gpu_loaded_and_the_pass_leaves_no_trace() -> None:
    task_type = find_task("Cartpole")
    state = torch.get_rng_state()
    ppo = find_algorithm("ppo")
    wp.load_module(ppo.kernels[0], "cpu")  # which has no part in what a GPU loads
    found = kernels_of(task_type, task_type.config_type(), "cpu", algorithms=tuple(ppo.kernels), for_gpu=True)
    listed = {(family(each.module.name), each.block_dim) for each in found}
    assert set(kept("Cartpole") or ()) <= listed and kept("Cartpole")
    assert torch.equal(torch.get_rng_state(), state)
    again = kernels_of(task_type, task_type.config_type(), "cpu", algorithms=tuple(ppo.kernels), for_gpu=True)
    assert {each.name for each in again} == {
        each.name for each in found
    }  # no address, no number of a pass is in a name
    task = task_type(task_type.config_type(), 2)
    task.step(torch.ones_like(task.actions))
    assert task.rewards.isfinite().all() and task.captured  # launches are made again


def test_a_kernel_for_any_number_of_worlds_is_listed() -> None:
    task_type = find_task("Ant")
    names = []
    for worlds in (2, 5):
        names.append({each.name for each in kernels_of(task_type, task_type.config_type(), "cpu", worlds=worlds)})
    assert names[0] == names[1]


def test_hashes_are_no_part_of_a_family() -> None:
    assert family("_friction_dof__locals__kernel_77566928") == "_friction_dof__locals__kernel"
    assert family("muster.task.f7ef276f1a81-0") == "muster.task"
    assert family("mujoco_warp._src.smooth") == "mujoco_warp._src.smooth"
    assert making.SHIPPED.exists()


def test_no_adjoints_are_compiled_for_a_task_whose_module_imports_newton_first(tmp_path: Path) -> None:
    (tmp_path / "own_task.py").write_text("import newton\nfrom worker.tasks.library.cartpole import Cartpole as Own\n")
    code = (
        "from worker.tasks import find_task; find_task('own_task:Own')\n"
        "import warp as wp; print({wp.get_module(name).options['enable_backward'] for name in ('newton._src.geometry.bvh', "
        "'newton._src.solvers.mujoco.kernels', 'worker.simulation.episodes')})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.stdout.strip() == "{False}", done.stderr
