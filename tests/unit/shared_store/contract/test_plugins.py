"""Declarations of plug-ins: each field is checked, and so are the names that two of them may not share."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from shared_store.contract import plugins as declared
from shared_store.contract.plugins import (
    OF_RUN,
    OF_STORE,
    Command,
    JobSection,
    Plugin,
    PluginError,
    load,
    plugins,
    rules_of,
    sections,
)
from shared_store.volume.layout import Store
from shared_store.volume.references import references
from tests.support.plugin_packages import write_package
from tests.support.refusals import refusal

SECTION = dict(key="tally", verb="counts", model="t.m:Tally", rank="t.rank", rules="t.m:RULES", watcher="t.m:Watcher")
A_SECTION = f"JobSection(**{SECTION})"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder that is the path's last, so that the plug-ins that are installed here stay."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    before = set(sys.modules)
    for each in (plugins, sections):
        each.cache_clear()
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]
    for each in (plugins, sections):
        each.cache_clear()


@pytest.mark.parametrize(
    ("declare", "words"),
    [
        (lambda: Plugin(folders="tally"), "folders: expected a tuple, found 'tally'"),  # type: ignore[arg-type]
        (lambda: Plugin(folders=(3,)), "folders: expected the name of a folder, of letters, digits, '_' and '-', found 3"),  # type: ignore[arg-type]
        (lambda: Plugin(folders=("../x",)), "folders: expected the name of a folder, of letters, digits, '_' and '-', found '../x'"),
        (lambda: Plugin(folders=("runs",)), "folders: runs is a folder of Muster's own; choose another name"),
        (lambda: Plugin(run_folders=("logs",)), "run_folders: logs is a folder of Muster's own; choose another name"),
        (lambda: Plugin(operations=("FETCH api/tally",)), "operations: expected METHOD /path, such as GET /api/notes, found 'FETCH api/tally'"),
        (lambda: Plugin(routers=("tally.routes",)), "routers: expected module:name, found 'tally.routes'"),
        (lambda: Plugin(navigation=("Tally", "/tally")), "navigation: expected tuples of 2 texts, found 'Tally'"),  # type: ignore[arg-type]
        (lambda: Plugin(navigation=(("Tally", "tally"),)), "navigation: expected a path that begins with /, found 'tally'"),
        (lambda: Plugin(commands=(("tally", "m"),)), "commands: expected Command(…), found ('tally', 'm')"),  # type: ignore[arg-type]
        (lambda: Plugin(references=5), "references: expected module:name, found 5"),  # type: ignore[arg-type]
        (lambda: Plugin(templates="a b"), "templates: expected a module, such as package.module, found 'a b'"),
        (lambda: Command("Tally", "t.m", "Runs", "Count."), "Command.name: expected a name of lower-case letters, digits and '-', found 'Tally'"),
        (lambda: JobSection(**{**SECTION, "rules": "t.m"}), "JobSection.rules: expected module:name, found 't.m'"),
    ],
)  # fmt: skip
def test_a_field_of_another_form_is_refused_by_its_name(declare: Callable[[], object], words: str) -> None:
    assert refusal(declare, error=PluginError) == words


def test_no_folder_is_one_of_the_layout(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for owner, known in ((store, OF_STORE), (store.run("ant-1"), OF_RUN)):
        paths = [getattr(owner, name) for name in vars(type(owner)) if name != "path" and not name.startswith("__")]
        folders = {each.name for each in paths if isinstance(each, Path) and not each.suffix}
        assert folders and folders <= known


def test_a_package_whose_declaration_is_wrong_is_named_with_the_plug_in(folder: Path) -> None:
    write_package(folder, "tally", "Plugin(folders='tally')")
    assert refusal(plugins, error=PluginError) == (
        "plug-in tally of the package tally: folders: expected a tuple, found 'tally'"
    )


@pytest.mark.parametrize(
    ("declaration", "what"),
    [
        ("Plugin(folders=('counts',))", "folder counts"),
        ("Plugin(run_folders=('counts',))", "folder of runs counts"),
        ("Plugin(commands=(Command('count', 't.m', 'Runs', 'Count.'),))", "command count"),
        (f"Plugin(sections=({A_SECTION},))", "section tally"),
    ],
)
def test_two_plug_ins_share_no_name(folder: Path, declaration: str, what: str) -> None:
    write_package(folder, "tally", declaration)
    write_package(folder, "score", declaration)
    assert refusal(plugins, error=PluginError) == (
        f"plug-in tally: the {what} is there twice, in the packages score and tally; remove one of them (pip uninstall)"
    )


def test_two_packages_with_a_plug_in_of_one_name_are_both_named(folder: Path) -> None:
    for package in ("muster_tally", "other_tally"):
        about = folder / f"{package}-1.0.dist-info"
        about.mkdir()
        (about / "entry_points.txt").write_text("[muster.plugins]\ntally=tally:PLUGIN\n")
    (folder / "tally.py").write_text("from shared_store.contract.plugins import Plugin\nPLUGIN = Plugin()\n")
    assert refusal(plugins, error=PluginError) == (
        "plug-in tally: the packages muster-tally and other-tally bring one of this name; remove one of them (pip uninstall)"
    )


def test_of_two_copies_of_a_package_the_one_counts_that_comes_first_on_the_path(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_package(folder / "first", "tally", "Plugin(folders=('first',))")
    write_package(folder / "second", "tally", "Plugin(folders=('second',))")
    monkeypatch.setattr(sys, "path", [*sys.path, str(folder / "first"), str(folder / "second")])
    assert plugins()["tally"].folders == ("first",)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("raise SystemExit(3)", "tally:PLUGIN can't be imported (it exits with 3)"),
        ("1 / 0", "tally:PLUGIN can't be imported (division by zero)"),
        ("PLUGIN = 3", "tally:PLUGIN is not a Plugin of shared_store.contract.plugins"),
    ],
)
def test_a_plug_in_that_can_t_be_imported_is_one_line(folder: Path, line: str, words: str) -> None:
    write_package(folder, "tally", f"Plugin()\n{line}")
    message = refusal(plugins, error=PluginError)
    assert message.startswith(f"plug-in tally of the package tally: {words}") and "\n" not in message


@pytest.mark.parametrize(
    ("code", "kind", "words"),
    [
        ("", object, "can't be imported (module 'tally_parts' has no attribute 'part')"),
        ("import sys; sys.exit('no')", object, "can't be imported (it exits with 'no')"),
        ("part = 3", str, "is int, and no str"),
    ],
)
def test_a_part_that_can_t_be_used_is_named_with_its_plug_in_and_field(
    folder: Path, code: str, kind: Any, words: str
) -> None:
    write_package(folder, "tally", "Plugin(references='tally_parts:part')", code)
    message = refusal(load, "tally_parts:part", kind, error=PluginError)
    assert message.startswith(f"plug-in tally: references: tally_parts:part {words}") and "\n" not in message


def test_rules_lack_nothing(folder: Path) -> None:
    section = A_SECTION.replace("t.m:RULES", "tally_parts:RULES")
    write_package(folder, "tally", f"Plugin(sections=({section},))", "class RULES: count = ('trials', 3)")
    assert refusal(rules_of, "tally", error=PluginError) == (
        "plug-in tally: sections: tally_parts:RULES is not an EvaluationRules: it has no refusal"
    )
    assert rules_of("evaluate") is None and declared.evaluating()[-1] == "tally"


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("", "can't be imported (module 'tally_parts' has no attribute 'references'); install its package again, or remove it"),
        ("def references(store): return 3", "failed ('int' object is not iterable); tell the plug-in's author, or remove it"),
        ("def references(store): yield 3", "failed (it yields 3, which is neither Needed nor Unreadable); tell the plug-in's author, or remove it"),
        ("def references(store): raise KeyError('run')", "failed ('run'); tell the plug-in's author, or remove it"),
    ],
)  # fmt: skip
def test_references_that_fail_may_need_anything(folder: Path, code: str, words: str) -> None:
    write_package(folder, "tally", "Plugin(references='tally_parts:references')", code)
    needed, unreadable = references(Store(folder / "store"))
    assert (len(needed), len(unreadable)) == (0, 1)
    assert f"plug-in tally: references: tally_parts:references {words}" in str(unreadable[0])
