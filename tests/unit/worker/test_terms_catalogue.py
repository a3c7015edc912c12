"""The pages of all terms are those that their docstrings give, and every term is reached by its name, here and in other libraries."""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest
import warp as wp

from docs.tools.terms_pages import porting, reference
from tests.conftest import REPOSITORY
from worker.simulation.declared_randomization import QUANTITIES
from worker.tasks import terms
from worker.tasks.declare.term_needs import needs_of
from worker.tasks.terms.aliases import ELSEWHERE, LIBRARIES, aliases, all_terms, meaning_and_names

HELPERS = ("resolve_env_ids",)
"""Functions of mjlab's modules that are not terms."""
NAMES = (REPOSITORY / "tests" / "data" / "former" / "terms.txt").read_text().split()
"""All terms that were ever documented."""


def mjlab() -> Path:
    """The directory of the installed package, which is read and not imported."""
    found = find_spec("mjlab")
    assert found is not None and found.submodule_search_locations, "make env installs it"
    return Path(found.submodule_search_locations[0])


@pytest.mark.parametrize(("page", "written"), [("terms", reference), ("porting", porting)])
def test_a_page_is_up_to_date(page: str, written: Callable[[], str]) -> None:
    assert (REPOSITORY / "docs" / "tasks" / f"{page}.md").read_text() == written()


def test_every_term_is_reached_by_its_name_and_says_what_it_is() -> None:
    found = {name: function for _, name, function in all_terms()}
    assert {*NAMES} <= {*found} and len(found) == sum(1 for _ in all_terms())
    assert {name for name in dir(terms) if isinstance(getattr(terms, name), wp.Function)} == {*found}
    for name, function in found.items():
        assert getattr(terms, name) is function and function.key == name
        assert function.func is not None and "world" in inspect.signature(function.func).parameters
        assert meaning_and_names(function)[0].endswith("."), name


def test_terms_that_no_shipped_task_uses_are_imported_when_one_is_used_and_an_unknown_name_has_the_nearest() -> None:
    code = (
        "import sys; from worker.tasks import find_task, terms; find_task('G1Rough')\n"
        "loaded = [name for name in sys.modules if name.startswith('worker.tasks.terms.more')]\n"
        "from worker.tasks.terms import joint_power\n"
        "from worker.tasks.terms.tracking import motion_command\n"
        "print(loaded, joint_power.key, motion_command is terms.motion_command)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[] joint_power True"
    with pytest.raises(AttributeError, match=r"there is no term 'joint_powr'; did you mean joint_power\?"):
        _ = terms.joint_powr


def test_a_composed_term_has_the_needs_and_defaults_of_its_parts_and_a_source_that_is_always_the_same() -> None:
    assert inspect.getsource(terms.upright.func) == (
        "def upright(world: int, worlds: WorldArrays, robot: RobotArrays, std: float) -> float:\n"
        "    return of_likeness(of_tilt_squared(world, worlds, robot), std)\n"
    )
    assert terms.reset_root_on_terrain.func.__defaults__ == (wp.vec2(0.0, 0.0),) * 12
    assert needs_of(terms.reset_root_on_terrain).free_root


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_name_of_another_library_is_our_term_that_names_it_without_a_remark_or_says_what_to_use_instead(
    library: str,
) -> None:
    module, known = getattr(terms, library), aliases(library)
    assert len(known) > 80 and dir(module) == sorted(known)
    named = [(name, each) for _, name, each in all_terms()]
    exact = Counter()
    for name, function in named:
        for theirs, remark in meaning_and_names(function)[1][library]:
            if theirs.isidentifier():
                assert library in ("mjlab", "isaaclab") and isinstance(getattr(module, theirs), wp.Function)
                if not remark:
                    exact[theirs] += 1
                    assert getattr(module, theirs) is getattr(terms, name)
    assert exact.most_common(1)[0][1] == 1
    assert module.joint_vel_l2 is terms.joint_velocity_squared
    with pytest.raises(
        AttributeError, match=rf"no term has the name 'joint_vel_l3' in {LIBRARIES[library]}; .*joint_vel_l2"
    ):
        _ = module.joint_vel_l3
    instead = {"mjlab": ("camera_rgb", "`Image` of a"), "isaaclab": ("modify_env_param", "curriculum")}[library]
    with pytest.raises(
        AttributeError, match=rf"{instead[0]} is not a term here \(docs/tasks/porting.md\): .*{instead[1]}"
    ):
        getattr(module, instead[0])


def test_the_page_of_names_has_all_terms_of_mjlabs_tasks() -> None:
    """Some have one here, and the others a row that says what to use instead."""
    modules = ("observations", "rewards", "terminations", "events", "curriculums", "metrics", "actions/actions")
    files = [mjlab() / "envs" / "mdp" / f"{name}.py" for name in modules]
    files += [each for name in modules for each in (mjlab() / "tasks").glob(f"*/mdp/{name}.py")]
    theirs = {
        node.name
        for file in files
        for node in ast.parse(file.read_text()).body
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
    }
    theirs = {name for name in theirs if not name.endswith(("Cfg", "Stage")) and name not in ("BaseAction", *HELPERS)}
    assert len(theirs) > 80
    assert theirs - set(re.findall(r"`(\w+)", porting())) == set()


def test_no_name_is_both_a_term_here_and_elsewhere() -> None:
    assert len(ELSEWHERE) > 10
    assert ELSEWHERE.keys() & {*aliases("mjlab"), *aliases("isaaclab")} == set()


def test_the_page_on_randomisation_has_all_quantities_of_mjlab_and_names_only_ours() -> None:
    page = (REPOSITORY / "docs" / "tasks" / "randomization.md").read_text().partition("## Names of mjlab")[2]
    theirs, ours = page.partition("| Isaac Lab's |")[0], re.findall(r'`Randomize\("(\w+)"', page)
    tree = ast.parse((mjlab() / "envs" / "mdp" / "dr" / "__init__.py").read_text())
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom) and node.module != "_types"]
    expected = {alias.name for node in imports for alias in node.names}
    assert len(expected) > 40
    listed = {name for row in re.findall(r"^\| (`[^|]*)", theirs, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)}
    assert listed == expected
    assert ours and set(ours) <= set(QUANTITIES)
