"""Further documents of a bundle: plain names that no other file has, whoever brings them; else one line that says who."""

from __future__ import annotations

from typing import Any

import pytest

from shared_store.contract import plugins as contract
from shared_store.contract.plugins import Plugin, PluginError
from worker.deploy import bundle as module
from worker.deploy.bundle import bundle_documents
from worker.settings.errors import UserError
from worker.tasks.library.cartpole import Cartpole

PARTS: dict[str, Any] = {}


class Documented(Cartpole):
    """A task with a document."""

    def bundle_documents(self, algorithm: str) -> dict[str, dict[str, Any]]:
        return {"task.json": {"algorithm": algorithm}}


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two plug-ins, whose parts a test sets."""
    names = ("first", "second")
    PARTS.clear()
    PARTS.update({f"{name}:parts": lambda task: {} for name in names})
    for owner in (module, contract):
        monkeypatch.setattr(owner, "plugins", lambda: {name: Plugin(bundle_parts=f"{name}:parts") for name in names})
    monkeypatch.setattr(module, "load", PARTS.__getitem__)


def documents() -> dict[str, Any]:
    return bundle_documents(Documented.__new__(Documented), "ppo")


def test_the_task_and_each_plug_in_add_documents() -> None:
    PARTS["first:parts"] = lambda task: {"first.json": {"task": type(task).__name__}}
    PARTS["second:parts"] = lambda task: {"second.json": {}}
    assert documents() == {"task.json": {"algorithm": "ppo"}, "first.json": {"task": "Documented"}, "second.json": {}}


NAMES = [
    "../x.json",
    "/x.json",
    "a/b.json",
    "..",
    "",
    ".json",
    ".x.json",
    "x.txt",
    "policy.onnx",
    "robot",
    "x.json\n",
    3,
]


@pytest.mark.parametrize("name", NAMES)
def test_a_name_that_is_not_a_plain_one_is_refused(name: Any) -> None:
    PARTS["first:parts"] = lambda task: {name: {}}
    with pytest.raises(
        UserError, match=r"plug-in first: bundle_parts: .* can't be a file of a bundle; use a plain name"
    ):
        documents()


@pytest.mark.parametrize("name", ["contract.json", "report.json", "manifest.json"])
def test_a_file_of_every_bundle_is_not_replaced(name: str) -> None:
    PARTS["second:parts"] = lambda task: {name: {"evil": 1}}
    with pytest.raises(UserError, match=rf"plug-in second: bundle_parts: {name} is a file of every bundle"):
        documents()


def test_two_documents_of_one_name_are_refused() -> None:
    PARTS["first:parts"] = PARTS["second:parts"] = lambda task: {"notes.json": {}}
    with pytest.raises(
        UserError, match=r"plug-in second: bundle_parts: plug-in first: bundle_parts puts notes.json into"
    ):
        documents()
    PARTS["second:parts"] = lambda task: {"task.json": {}}
    with pytest.raises(
        UserError, match=r"plug-in second: bundle_parts: task Documented: bundle_documents puts task.json"
    ):
        documents()


def broken(task: Any) -> Any:
    raise KeyError("worlds")


def absent(task: Any) -> Any:
    raise PluginError("plug-in: gone:parts can't be imported; install its package again")


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        (broken, r"plug-in first: bundle_parts: first:parts failed \('worlds'\)"),
        (absent, "gone:parts can't be imported"),
        (lambda task: ["notes.json"], "first:parts returned .*; return documents by their names"),
        (lambda task: {"notes.json": [1]}, "notes.json is not a JSON object"),
        (lambda task: {"notes.json": {"a": object()}}, "notes.json is not a JSON object"),
    ],
)
def test_what_is_no_document_is_one_line(parts: Any, words: str) -> None:
    PARTS["first:parts"] = parts
    with pytest.raises((UserError, PluginError), match=words) as refused:
        documents()
    assert "\n" not in str(refused.value)
