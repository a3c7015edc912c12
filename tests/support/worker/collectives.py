"""Where ``worker`` enters a collective: by its syntax trees, and by watching ranks.

A function is named by its file in ``worker`` and its qualified name: ``learning/state.py:TrainingState.restore``.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import pytest

WORKER = Path(__file__).resolve().parents[3] / "worker"
_GANG = re.compile(r"(^|\.)_?gang$")
"""What an expression ends with whose value is a gang. A gang of one may be called ``alone``; :func:`other_names` finds other names."""
_OF_A_GANG = ("sum", "broadcast", "greatest", "broadcast_text", "in_turn")
_OF_TORCH = ("init_process_group", "all_reduce", "broadcast", "broadcast_object_list", "all_gather", "barrier")
_OF_A_STORE = ("set", "get", "wait")
_OF_RSL_RL = ("broadcast_parameters",)
_PARTS = {
    "_exchange": "learning/exchange.py:Exchange",
    "learner": "learning/sac/learner.py:Learner",
    "loop": "learning/loop.py:Loop",
    "state": "learning/state.py:TrainingState",
}
"""The classes of attributes and variables on which methods are called that enter a collective."""


_CONNECT = "learning/distributed.py:connect"
"""Forms the gang, and is not a path to a collective for those who call it."""


class Call(NamedTuple):
    """A call that enters a collective, directly or through other functions of ``worker``."""

    function: str
    first: int
    last: int
    """Its lines."""


class _Module(ast.NodeVisitor):
    """The calls of one module: with what they call, as far as that is known."""

    def __init__(self, path: Path) -> None:
        self.file = str(path.relative_to(WORKER))
        self.calls: list[tuple[Call, str]] = []
        self.gangs: list[str] = []
        """Where a gang gets a name that :data:`_GANG` does not know."""
        self._names: dict[str, str] = {}
        self._scope: list[str] = []
        self._class: list[str] = []
        self._function = "<module>"
        tree = ast.parse(path.read_text())
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                self._names[node.name] = f"{self.file}:{node.name}"
        for found in ast.walk(tree):
            if isinstance(found, ast.ImportFrom) and (found.module or "").startswith("worker."):
                file = f"{str(found.module).removeprefix('worker.').replace('.', '/')}.py"
                self._names |= {each.asname or each.name: f"{file}:{each.name}" for each in found.names}
        self.visit(tree)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._class.append(node.name)
        self._inside(node, [node.name], self._function)
        self._class.pop()

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        supplied = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        for each in supplied:
            if each.annotation and ast.unparse(each.annotation).strip("'\"") == "Gang" and not _GANG.search(each.arg):
                self.gangs.append(f"{self.file}:{node.name}: {each.arg}")
        self._inside(node, [node.name], ".".join([*self._scope, node.name]), ["<locals>"])

    def _inside(self, node: ast.AST, name: list[str], function: str, within: list[str] | None = None) -> None:
        before = self._scope, self._function
        self._scope, self._function = [*self._scope, *name, *(within or [])], function
        self.generic_visit(node)
        self._scope, self._function = before

    def visit_Assign(self, node: ast.Assign) -> None:
        made = isinstance(node.value, ast.Call) and ast.unparse(node.value.func) in ("connect", "Gang")
        if made or _GANG.search(ast.unparse(node.value)):
            targets = [each for target in node.targets for each in getattr(target, "elts", [target])]
            names = [ast.unparse(each) for each in targets]
            self.gangs += [
                f"{self.file}:{self._function}: {name}"
                for name in names
                if not _GANG.search(name) and not (made and name == "alone")
            ]
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        supplied = [each.id for each in node.args if isinstance(each, ast.Name)]
        if "alone" not in supplied and (callee := self._callee(node.func)):
            line = node.func.end_lineno or node.lineno
            call = Call(f"{self.file}:{self._function}", node.lineno, max(line, node.end_lineno or line))
            self.calls.append((call, callee))
        self.generic_visit(node)

    def _callee(self, called: ast.expr) -> str | None:
        """A function of ``worker``, a class of it, or ``collective``."""
        if isinstance(called, ast.Name):
            return self._names.get(called.id)
        if not isinstance(called, ast.Attribute):
            return None
        owner = ast.unparse(called.value)
        if (
            (called.attr in _OF_A_GANG and _GANG.search(owner))
            or (called.attr in _OF_TORCH and owner == "dist")
            or called.attr in _OF_RSL_RL
            or (owner == "self.store" and called.attr in _OF_A_STORE)
        ):
            return "collective"
        if owner == "self" and self._class:
            return f"{self.file}:{self._class[-1]}.{called.attr}"
        part = _PARTS.get(owner.rpartition(".")[2])
        return f"{part}.{called.attr}" if part else None


def _modules() -> list[_Module]:
    return [_Module(path) for path in sorted(WORKER.rglob("*.py"))]


def paths() -> list[Call]:
    """All calls in ``worker`` that enter a collective, in functions that do so directly or through others."""
    calls = [each for module in _modules() for each in module.calls]
    calls = [(call, callee) for call, callee in calls if callee != _CONNECT]
    enter, before = {"collective"}, 0
    while len(enter) > before:
        before = len(enter)
        for call, callee in calls:
            if callee in enter:
                enter |= {call.function, call.function.removesuffix(".__init__")}
    return [call for call, callee in calls if callee in enter]


def other_names() -> list[str]:
    """Where a gang has a name by which :func:`paths` does not know it."""
    return [each for module in _modules() for each in module.gangs]


@contextlib.contextmanager
def watching() -> Iterator[set[tuple[str, int]]]:
    """Every function of ``worker``, with its line, from which this process enters a collective; a gang of one enters none."""
    import torch.distributed as dist

    seen: set[tuple[str, int]] = set()

    def noting(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def called(*arguments: Any, **options: Any) -> Any:
            frame: FrameType | None = sys._getframe(1)
            while frame is not None:
                if frame.f_code.co_filename.startswith(f"{WORKER}/"):
                    name = re.sub(r"(\.<locals>\.<\w+>)+$", "", frame.f_code.co_qualname)
                    seen.add((f"{Path(frame.f_code.co_filename).relative_to(WORKER)}:{name}", frame.f_lineno))
                frame = frame.f_back
            return function(*arguments, **options)

        return called

    with pytest.MonkeyPatch.context() as patch:
        for owner, names in ((dist, _OF_TORCH), (dist.Store, _OF_A_STORE)):
            for name in names:
                patch.setattr(owner, name, noting(getattr(owner, name)))
        yield seen


ALONE = {
    "export.py:main": "the main rank exports, and the others leave at once",
}
"""Paths that a gang of one takes alone, and why."""
TESTS = {
    f"{file}:{function}": f"test_{case}"
    for case, files in {
        "a_training_is_the_same_on_all_ranks_to_its_end": {
            "learning/distributed.py": "Gang.broadcast Gang.broadcast_text Gang.greatest Gang.in_turn Gang.sum connect",
            "evaluation/evaluation.py": "evaluate",
            "evaluation/final_evaluation.py": "FinalEvaluation.trained",
            "learning/training.py": "as_started",
            "learning/exchange.py": "Exchange.gather",
            "learning/leaving.py": "train",
            "learning/loop.py": "Loop.__init__ Loop._begin_run Loop._iterate Loop.train",
            "learning/ppo/fused.py": "PPO.__init__ PPO._learn PPO.learn",
            "learning/setup.py": "build_algorithm build_task load_kernels",
            "learning/state.py": "TrainingState.finish",
            "train.py": "_train main",
        },
        "an_evaluation_has_the_episodes_of_all_ranks_in_every_round": {
            "evaluate.py": "main main.<locals>.build",
            "evaluation/episodes.py": "_gather play",
            "learning/trained.py": "choose_checkpoint chosen_by_main",
        },
        "episodes_are_played_until_the_last_one_of_any_rank_has_ended": {"evaluation/episodes.py": "_one_round"},
        "a_request_to_leave_that_one_rank_has_got_ends_all_with_a_checkpoint": {"learning/loop.py": "Loop._handle"},
        "a_resumed_gang_takes_the_newest_checkpoint_that_can_be_read": {"learning/state.py": "TrainingState.restore"},
        "a_clone_begins_with_the_same_weights_on_all_ranks": {"learning/loaded_weights.py": "adopt"},
        "all_ranks_have_the_teacher_whether_it_was_copied_or_not": {"learning/loaded_weights.py": "load_teacher"},
        "worlds_that_do_not_fit_are_refused_by_all_ranks": {
            "learning/memory_estimate.py": "_taken measure within_memory"
        },
        "worlds_drawn_at_random_are_built_anew_for_the_evaluation": {
            "evaluation/final_evaluation.py": "held_out_worlds"
        },
        "a_last_save_that_fails_on_one_rank_is_tried_again_by_all_until_a_stop": {"learning/leaving.py": "complete"},
        "a_loss_that_is_not_finite_ends_all_ranks_after_their_saves": {"learning/loop.py": "Loop._failure"},
        "too_many_resets_on_one_rank_end_all_after_it_has_written_why": {"learning/loop.py": "Loop._judge_resets"},
        "start_frames_follow_the_failures_of_all_ranks": {"learning/loop.py": "Loop._begin_iteration"},
        "sac_has_the_same_learner_and_metrics_on_all_ranks_and_each_its_own_worlds": {
            "learning/sac/learner.py": "Learner.__init__",
            "learning/sac/sac.py": "SAC.__init__ SAC._observe SAC._update",
        },
        "rsl_rl_has_the_same_weights_normalizers_and_metrics_on_all_ranks": {
            "learning/rsl/algorithm.py": "RslRl.__init__ RslRl._share_statistics RslRl.learn"
        },
    }.items()
    for file, functions in files.items()
    for function in functions.split()
}
"""By the path, the test of ``tests/training/worker/test_gangs.py`` in which two ranks take it."""
