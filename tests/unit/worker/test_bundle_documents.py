"""Further documents of a bundle: plain names that no other file has, from the task or a plug-in; else one line that names it."""

from __future__ import annotations

from typing import Any

import pytest

from shared_store.contract import plugins as contract
from shared_store.contract.plugins import Plugin, PluginError
from worker.deploy import bundle
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
    for owner in (bundle, contract):
        monkeypatch.setattr(owner, "plugins", lambda: {name: Plugin(bundle_parts=f"{name}:parts") for name in names})
    monkeypatch.setattr(bundle, "load", PARTS.__getitem__)


def documents() -> dict[str, Any]:
    return bundle.bundle_documents(Documented.__new__(Documented), "ppo")


def test_the_task_and_each_plug_in_add_documents() -> None:
    PARTS["first:parts"] = lambda task: {"first.json": {"task": type(task).__name__}}
    PARTS["second:parts"] = lambda task: {"second.json": {}}
    assert documents() == {"task.json": {"algorithm": "ppo"}, "first.json": {"task": "Documented"}, "second.json": {}}


def broken(task: Any) -> Any:
    raise KeyError("worlds")


def absent(task: Any) -> Any:
    raise PluginError("plug-in: gone:parts can't be imported; install its package again")


NAMES = (
    *["../x.json", "/x.json", "a/b.json", "..", ".json", ".x.json", "x.txt", "policy.onnx", "robot"],
    "",
    "x.json\n",
    3,
)
FIRST, SECOND = "plug-in first: bundle_parts:", "plug-in second: bundle_parts:"


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        *(({name: {}}, {}, f"{FIRST} .* can't be a file of a bundle; use a plain name") for name in NAMES),
        *(
            ({}, {name: {"evil": 1}}, f"{SECOND} {name} is a file of every bundle")
            for name in ("contract.json", "report.json", "manifest.json")
        ),
        ({"notes.json": {}}, {"notes.json": {}}, f"{SECOND} {FIRST[:-1]} puts notes.json into"),
        ({}, {"task.json": {}}, f"{SECOND} task Documented: bundle_documents puts task.json"),
        (broken, {}, rf"{FIRST} first:parts failed \('worlds'\)"),
        (absent, {}, "gone:parts can't be imported"),
        (["notes.json"], {}, "first:parts returned .*; return documents by their names"),
        ({"notes.json": [1]}, {}, "notes.json is not a JSON object"),
        ({"notes.json": {"a": object()}}, {}, "notes.json is not a JSON object"),
    ],
)
def test_anything_but_a_document_of_its_own_is_refused_in_one_line(first: Any, second: Any, words: str) -> None:
    PARTS["first:parts"] = first if callable(first) else lambda task: first
    PARTS["second:parts"] = lambda task: second
    with pytest.raises((UserError, PluginError), match=words) as refused:
        documents()
    assert "\n" not in str(refused.value)
