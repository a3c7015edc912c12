"""The pages of the model registry, through a real server."""

from __future__ import annotations

import pytest

from shared_store.layout import Store
from shared_store.models import Model
from tests.support.console.fixtures import Console
from tests.support.console.racers import add_racer

HOSTILE = "</text><script>alert(1)</script>"


@pytest.fixture(scope="module")
def fast(console: Console) -> Model:
    """Version 3 of ``fast``: of a clone of the run of version 1; and a model of the queue ``lab``."""
    store = Store(console.server.home / "store")
    add_racer(store, "fast", "first", 5)
    add_racer(store, "fast", "second", 7, parent={"run": "first", "iteration": 5, "checkpoint": "x"})
    add_racer(store, "theirs", "of-lab", 2, "lab")
    return add_racer(store, "fast", "second", 9, registered_by=HOSTILE)


def test_the_newest_version_of_each_model_is_listed(console: Console, fast: Model) -> None:
    page = console.visitor().page("/models")
    links = [each["href"] for each in page.all("a") if str(each["href"]).startswith("/models/")]
    assert links == ["/models/fast", "/models/theirs"]
    assert "second@9" in page.text and "100.00" in page.text
    lab = console.visitor("lab").page("/models")
    assert "theirs" in lab.text and "fast" not in lab.text
    refused = console.visitor("lab").page("/models/fast", 403)
    assert "may use job queue lab only" in refused.text and "second" not in refused.text


def test_a_model_has_its_lineage_as_a_graph_its_evaluations_and_its_job(console: Console, fast: Model) -> None:
    page = console.visitor("reader").page("/models/fast")
    links = [str(each["href"]) for each in page.all("a") if each.get("href")]
    for place in ("/runs/first", "/runs/second", *(f"/models/fast?version={number}" for number in (1, 2, 3))):
        assert place in links, place
    assert len(page.all("rect")) == 5 and page.source.count("<path d=") == 4
    assert all(each in page.text for each in ("@5", "@7", "@9", "score 3.50"))
    assert "100.00" in page.text and "185.0 of 18000" in page.text and "task: Racer" in page.text
    assert "Control rate 15 Hz" in page.text and "Actions steering, speed" in page.text
    assert "fast@1" in page.text and "Every file is as" not in page.text
    first = console.visitor().page("/models/fast?version=1")
    assert "Model fast@1" in first.text and "first@5" in first.text


def test_verify_reads_every_file_and_names_the_one_that_was_altered(console: Console, fast: Model) -> None:
    visitor = console.visitor("reader")
    assert "Every file is as it was registered." in visitor.page("/models/theirs?verify=yes").text
    weights = fast.bundle / "policy.onnx"
    weights.chmod(0o644)
    weights.write_bytes(b"other w")
    told = visitor.page("/models/fast?verify=yes").text
    assert "policy.onnx" in told and "Every file is as" not in told
    weights.write_bytes(b"weights")


def test_what_others_wrote_is_text_and_unknown_models_are_told(console: Console, fast: Model) -> None:
    visitor = console.visitor()
    page = visitor.page("/models/fast")
    assert HOSTILE in page.text and page.is_inert and "<script>alert" not in page.source
    assert "did you mean fast?" in visitor.page("/models/fats", 404).text
    assert "has no version 9" in visitor.page("/models/fast?version=9", 404).text
    for path in (f"/models/{HOSTILE}", "/models/fast?version=x", "/models/..%2f..%2fkeys"):
        answer = visitor.http.get(path)
        assert answer.status_code in (400, 404) and "<script>alert" not in answer.text, path
