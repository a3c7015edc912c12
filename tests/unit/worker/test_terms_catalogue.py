"""The pages of all terms are those that their docstrings give, and every term is reached by its name."""

from __future__ import annotations

import ast
import inspect
import re
from importlib.util import find_spec
from pathlib import Path

import pytest
import warp as wp

from tests.conftest import REPOSITORY
from worker.simulation.declared_randomization import QUANTITIES
from worker.tasks import terms
from worker.tasks.terms.__main__ import main
from worker.tasks.terms.catalogue import ELSEWHERE, entries, porting, reference, split

HELPERS = ("resolve_env_ids",)
"""Functions of mjlab's modules that are no terms."""


def mjlab() -> Path:
    """The directory of the installed package, which is read and not imported."""
    found = find_spec("mjlab")
    assert found is not None and found.submodule_search_locations, "make env installs it"
    return Path(found.submodule_search_locations[0])


@pytest.mark.parametrize(("page", "written"), [("terms", reference), ("porting", porting)])
def test_a_page_is_up_to_date(page: str, written: object) -> None:
    assert callable(written)
    assert (REPOSITORY / "docs" / "tasks" / f"{page}.md").read_text() == written()


def test_every_term_is_in_the_catalogue_is_reached_by_its_name_and_says_what_it_is() -> None:
    found = list(entries())
    assert len(found) > 200
    names = {entry.name for entry in found}
    assert len(names) == len(found) and names == {
        name for name, each in vars(terms).items() if isinstance(each, wp.Function)
    }
    for entry in found:
        function = getattr(terms, entry.name)
        assert isinstance(function, wp.Function) and function.func.__module__ == f"worker.tasks.terms.{entry.group}"
        assert entry.meaning.endswith("."), entry.name
        assert "world" in inspect.signature(function.func).parameters
        assert (entry.returns == "") == (inspect.signature(function.func).return_annotation is inspect.Signature.empty)


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
    ported = {
        theirs.partition(" ")[0] for entry in entries() for theirs in (*split(entry.mjlab), *split(entry.isaac_lab))
    }
    elsewhere = [row.partition("|")[0] for row in re.findall(r"^\| (`.*)$", ELSEWHERE, re.MULTILINE)]
    assert len(elsewhere) > 10
    assert {name for row in elsewhere for name in re.findall(r"`(\w+)`", row)} & ported == set()


def test_the_page_on_randomisation_has_all_quantities_of_mjlab_and_names_only_ours() -> None:
    page = (REPOSITORY / "docs" / "tasks" / "randomization.md").read_text().partition("## Names of mjlab")[2]
    theirs, ours = page.partition("| Isaac Lab's |")[0], re.findall(r'`Randomize\("(\w+)"', page)
    tree = ast.parse((mjlab() / "envs" / "mdp" / "dr" / "__init__.py").read_text())
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom) and node.module != "_types"]
    wanted = {alias.name for node in imports for alias in node.names}
    assert len(wanted) > 40
    told = {name for row in re.findall(r"^\| (`[^|]*)", theirs, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)}
    assert told == wanted
    assert ours and set(ours) <= set(QUANTITIES)


def test_an_unknown_page_is_refused_in_one_line() -> None:
    with pytest.raises(SystemExit, match=r"there is no page 'portnig'; there are reference, porting"):
        main(["portnig"])
