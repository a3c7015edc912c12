"""The pages of models, through a real server."""

from __future__ import annotations

import pytest

from shared_store.volume.layout import Store
from shared_store.volume.models import Model
from tests.support.console.fixtures import Console
from tests.support.console.visitor import Visitor
from tests.support.orchestrator.models import add_model

HOSTILE = "'</text><script>alert(1)</script>"


@pytest.fixture(scope="module")
def fast(console: Console) -> Model:
    """Version 3 of ``fast``: of a clone of the run of version 1; and a model of the queue ``lab``."""
    store = Store(console.server.home / "store")
    add_model(store, "fast", "first", 5)
    add_model(store, "fast", "second", 7, parent={"run": "first", "iteration": 5, "checkpoint": "x"})
    add_model(store, "theirs", "of-lab", 2, "lab")
    return add_model(store, "fast", "second", 9, registered_by=HOSTILE)


def test_the_newest_version_of_each_model_is_listed(console: Console, fast: Model) -> None:
    page = console.visitor().page("/models")
    links = [each["href"] for each in page.all("a") if str(each["href"]).startswith("/models/")]
    assert [each for each in links if each != "/models/cart"] == ["/models/fast", "/models/theirs"]
    assert "second@9" in page.text and "100.00" in page.text
    lab = console.visitor("lab").page("/models")
    assert "theirs" in lab.text and "fast" not in lab.text
    refused = console.visitor("lab").page("/models/fast", 404)
    assert "model fast does not exist" in refused.text and "second" not in refused.text


def test_a_model_has_its_lineage_as_a_graph_its_evaluations_and_its_job(console: Console, fast: Model) -> None:
    page = console.visitor("reader").page("/models/fast")
    links = [str(each["href"]) for each in page.all("a") if each.get("href")]
    for place in ("/runs/first", "/runs/second", *(f"/models/fast?version={number}" for number in (1, 2, 3))):
        assert place in links, place
    assert len(page.all("rect")) == 5 and page.source.count("<path d=") == 4
    assert all(each in page.text for each in ("@5", "@7", "@9", "score 3.50"))
    assert "100.00" in page.text and "185.0 of 18000" in page.text and "task: Cartpole" in page.text
    assert "Control rate 15 Hz" in page.text and "Actions force, brake" in page.text
    assert "fast@1" in page.text and "Every file is as" not in page.text
    first = console.visitor().page("/models/fast?version=1")
    assert "Model fast@1" in first.text and "first@5" in first.text


def test_a_model_whose_robot_changed_says_so_and_differs_by_it(console: Console) -> None:
    store = Store(console.server.home / "store")
    for iteration, pole in ((2, 0.1), (3, 0.25)):
        add_model(store, "cart", "carts", iteration, pole=pole)
    assert "Robot trained on another robot: pole 0.25 kg" in console.visitor().page("/models/cart").text
    token = {"MUSTER_TOKEN": console.secrets["admin"]}
    shown = console.server.muster("models", "show", "cart@1", **token).stdout
    assert "robot:       trained on another robot: pole 0.1 kg; the bundle was made and judged with that file" in shown
    compared = console.server.muster("models", "diff", "cart", **token)
    assert compared.returncode == 1, compared.stderr
    assert "robot: mass [kg] 1.1 became 1.25; body pole: mass 0.1 became 0.25\n" in compared.stdout


def test_verify_reads_every_file_and_names_the_one_that_was_altered(console: Console, fast: Model) -> None:
    visitor = console.visitor("reader")
    assert "Every file is as it was registered." in visitor.page("/models/theirs?verify=yes").text
    weights = fast.bundle / "policy.onnx"
    weights.chmod(0o644)
    weights.write_bytes(b"other w")
    result = visitor.page("/models/fast?verify=yes").text
    assert "policy.onnx" in result and "Every file is as" not in result
    weights.write_bytes(b"weights")


def test_what_others_wrote_is_text_and_unknown_models_are_named(visitor: Visitor, fast: Model) -> None:
    page = visitor.page("/models/fast")
    assert HOSTILE in page.text and page.is_inert and "<script>alert" not in page.source
    assert "did you mean fast?" in visitor.page("/models/fats", 404).text
    assert "has no version 9" in visitor.page("/models/fast?version=9", 404).text
    for path in (f"/models/{HOSTILE}", "/models/fast?version=x", "/models/..%2f..%2fkeys"):
        answer = visitor.http.get(path)
        assert answer.status_code in (400, 404) and "<script>alert" not in answer.text, path
