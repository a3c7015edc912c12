"""The pages of runs and their comparison, through a real server; whatever a job wrote and a client asks for, pages show the rest."""

from __future__ import annotations

import json
import threading
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any

import httpx
import pyarrow
import pyarrow.parquet
import pytest

from orchestrator.api.turns import Turns
from orchestrator.domain.errors import ClientError
from shared_store.volume.files import DamagedFile, open_inside, write_json
from shared_store.volume.layout import Run, Store
from shared_store.volume.metrics import MetricsWriter
from tests.conftest import call_muster, wait_for
from tests.support.console.fixtures import Console
from tests.support.console.visitor import Page, Visitor
from tests.support.orchestrator.jobs import await_status
from tests.support.orchestrator.trained import SPEC, add_checkpoint, add_run

HOSTILE = "<script>alert(1)</script>"
LENGTHS = {"mean_length": 9.0, "max_length": 10}


def trained(store: Store, name: str, returns: list[float], **changes: Any) -> Run:
    """A run of 9 iterations whose last checkpoint is evaluated in as many episodes as there are returns."""
    train = {**SPEC["train"], "seed": 1, **changes.pop("train", {})}
    add_run(store, name, {**SPEC, "name": name, "train": train})
    run = store.run(name)
    facts = {"created": 1.7e12, "queue": "default", "owner": "key admin", **changes}
    write_json(run.path / "run.json", {**(run.description() or {}), **facts})
    for iteration in (6, 9):
        add_checkpoint(store, name, iteration)
    with MetricsWriter(run, 1, 0) as metrics:
        for i in range(1, 10):
            record = {"iteration": i, "env_steps": 100 * i, "reward": returns[0] * i, "kl": 0.01, "note": HOSTILE}
            metrics.write(record)
    mean, episodes = sum(returns) / len(returns), len(returns)
    found: dict[str, Any] = {**LENGTHS, "mean_return": mean, "episodes": episodes, "time": 1.7e9, "task": "Cartpole"}
    found |= {"seed": 7, "iteration": 9, "success": {"share": 0.75}}
    found["return"] = {"mean": mean, "low": mean - 1, "high": mean + 1}
    write_json(run.evaluations / "00000009-e1-job.json", found)
    columns = {"episode": list(range(len(returns))), "return": returns}
    pyarrow.parquet.write_table(pyarrow.table(columns), run.evaluations / "00000009-e1-job.parquet")
    return run


@pytest.fixture(scope="module")
def store(console: Console) -> Store:
    store = Store(console.server.home / "store")
    trained(store, "fast", [10.0, 20.0, 30.0, 41.0])
    trained(store, "fast-b", [12.0, 20.0, 30.0, 41.0], train={"seed": 2})
    parent = {"run": "fast", "checkpoint": "00000009-e1", "iteration": 9}
    trained(store, "sure", [11.0, 21.5, 31.0, 42.5], train={"worlds": 5}, parent=parent)
    trained(store, "labs", [1.0, 2.0], train={"worlds": 6}, queue="lab", owner="key lab")
    return store


def names(page: Page) -> list[str]:
    return [str(each["value"]) for each in page.all("input", name="run", type="checkbox")]


def test_the_list_has_every_run_with_its_task_and_best_evaluation(console: Console, store: Store) -> None:
    page = console.visitor().page("/runs")
    assert names(page) == ["fast", "fast-b", "labs", "sure"]
    assert page.all("time", datetime="2023-11-14T22:13:20+00:00")
    assert "Cartpole" in page.text and "25.2 at 9" in page.text and "key admin" in page.text
    assert names(console.visitor().page("/runs?search=FAST")) == ["fast", "fast-b"]
    assert names(console.visitor().page("/runs?after=fast-b")) == ["labs", "sure"]
    assert "No run matches" in console.visitor().page("/runs?search=nothing").text
    assert [each["run"] for each in console.client.get("/api/runs", search="fast")] == ["fast", "fast-b"]


def test_the_page_of_a_run_has_checkpoints_evaluations_and_lineage(console: Console, store: Store) -> None:
    page = console.visitor().page("/runs/sure")
    assert "00000009-e1" in page.text and "26.50 ± 1.00" in page.text and "75.0 %" in page.text
    table = console.visitor().http.get("/runs/sure/files/evaluations/00000009-e1-job.parquet")
    assert page.all("a", href=table.url.path) and table.content[:4] == b"PAR1"
    assert page.all("a", href="/runs/fast") and "No run was cloned from it" in page.text
    (curves,) = [each for each in page.all("section") if each.get("data-curves")]
    assert (curves["data-curves"], curves["data-metrics"]) == ("/runs/sure/curves", "reward kl")
    assert "Learning KL divergence 0.010" in page.text
    parent = console.visitor().page("/runs/fast")
    assert parent.all("a", href="/runs/sure") and parent.all("a", href="/compare?run=fast&run=sure")
    assert console.client.get("/api/runs/fast")["clones"] == ["sure"]
    assert "did you mean fast" in console.visitor().page("/runs/fsat", 404).text


def test_a_run_that_goes_on_is_renewed(console: Console, store: Store) -> None:
    run = trained(store, "goes-on", [1.0, 2.0], train={"worlds": 7})
    stream = console.visitor().events("/runs/goes-on/stream")
    _, first, place = next(stream)
    assert "KL divergence 0.010" in first["facts"] and json.loads(place)["i"] == 9
    assert first["checkpoints"]["order"] == ["00000009-e1", "00000006-e1"]
    with MetricsWriter(run, 1, 9) as metrics:
        figures = {"explained_variance": 0.5, "gradient_norm": 12.0, "warnings": ["it unlearns: (RUN@best)"]}
        metrics.write({"iteration": 10, "env_steps": 1000, "reward": 1.0, **figures})
    found = {name: data for name, data, _ in (next(stream), next(stream))}
    assert "explained variance 0.50, gradient norm 12" in found["parts"]["facts"]
    assert "it unlearns: (goes-on@best)" in found["parts"]["facts"]
    assert found["metrics"]["iterations"] == [10] and found["metrics"]["series"]["explained_variance"] == [0.5]
    add_checkpoint(store, "goes-on", 10)
    _, data, _ = next(stream)
    assert data["checkpoints"]["order"][0] == "00000010-e1"
    stream.close()


def test_the_comparison_is_that_of_the_command(console: Console, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUSTER_TOKEN", console.secrets["admin"])
    page = console.visitor().page("/compare?run=fast&run=sure")
    done = call_muster("compare", "fast", "sure", home=console.server.home)
    _, fast, sure, line = done.stdout.splitlines()
    assert line == "sure@9 against fast@9: return +1.25 (+0.79 to +1.71, paired over 4 episodes): better"
    assert line in page.text
    for row in (fast, sure):
        assert " ".join(row.split()) in page.text
    assert page.all("optgroup", label="other")
    grouped = console.visitor().page("/compare?run=fast*+sure").text
    assert "fast* (2)" in grouped and "1, 2" in grouped


def test_curves_over_seeds_have_their_spread(visitor: Visitor, store: Store) -> None:
    result = visitor.http.get("/compare/curves?run=fast*&run=sure", headers={"Accept": "application/json"}).json()
    group, single = result["lines"]
    assert (result["x"][0], result["x"][-1], len(result["x"])) == (100.0, 900.0, 200)
    assert group["name"] == "fast* (2)" and group["y"][0] == 11.0 and group["low"][0] == pytest.approx(11 - 2**0.5)
    assert group["high"][-1] == pytest.approx(99 + 9 * 2**0.5) and single["y"][0] == 11.0 and "low" not in single
    empty = visitor.http.get("/compare/curves?run=fast&metric=note", headers={"Accept": "application/json"}).json()
    assert empty["x"] == [] and empty["lines"][0]["y"] == []


def test_an_unknown_metric_is_refused_with_the_nearest_one(visitor: Visitor, store: Store) -> None:
    output = visitor.page("/compare?run=fast&metric=rewrd", 404).text
    assert "no run here has a metric 'rewrd'; did you mean reward?" in output


def test_a_key_sees_its_own_runs_alone(console: Console, store: Store) -> None:
    visitor = console.visitor("lab")
    assert names(visitor.page("/runs")) == ["labs"]
    for path in ("/runs/fast", "/compare?run=labs&run=fast", "/compare/curves?run=fast", "/runs/fast/stream"):
        assert "run fast does not exist" in visitor.page(path, 404).text
    assert "no run matches fas*" in visitor.page("/compare?run=fas*", 404).text
    assert names(console.visitor("reader").page("/runs?search=sure")) == ["sure"]


def test_what_is_in_a_run_is_text_and_nothing_else(visitor: Visitor, store: Store) -> None:
    parent = {"run": HOSTILE, "checkpoint": HOSTILE}
    run = trained(store, "hostile", [1.0], train={"task": HOSTILE, "seed": HOSTILE}, owner=HOSTILE, parent=parent)
    written = run.evaluations / "00000009-e1-job.json"
    summary = {**SPEC, **LENGTHS, "mean_return": 1.0, "episodes": 1, "time": 1.0}
    hostile = {"seed": HOSTILE, "config": {HOSTILE: HOSTILE}, "success": HOSTILE, "return": HOSTILE}
    write_json(written, {**summary, **hostile})
    add_checkpoint(store, "hostile", 12, reward=HOSTILE, score=[HOSTILE], created=HOSTILE)
    add_run(store, "odd", {"name": HOSTILE, "train": HOSTILE})
    compared = ("/compare?run=odd&run=hostile", "/compare?run=hostile&run=fast")
    for path in ("/runs", "/runs/odd", "/runs/hostile", *compared, f"/runs?search={HOSTILE}"):
        page = visitor.page(path)
        assert page.is_inert and "<script>alert" not in page.source, path
    for path in (f"/runs/{HOSTILE}", f"/compare?run={HOSTILE}"):
        answer = visitor.http.get(path)
        assert answer.status_code in (400, 404) and Page(answer.text).is_inert and "<script>alert" not in answer.text


def test_a_damaged_run_says_so_and_takes_no_other_away(console: Console, store: Store) -> None:
    run = trained(store, "damaged", [1.0])
    (run.path / "run.json").write_text("{")
    trained(store, "odd-age", [1.0], created=1e300)
    page = console.visitor().page("/runs?search=a")
    assert "damaged" in names(page) and "fast" in names(page) and "created is not a time" in page.text
    assert "damaged file" in console.visitor().page("/runs/damaged", 409).text


# -- what a job wrote in place of numbers, and clients that ask for too much -------------------------------------------


NUMBERS = (
    *("reward", "score", "score_error", "steps_per_second", "iteration_seconds", "time", "env_steps", "slowest_rank"),
    *("slowest_excess", "kl"),
)


def test_no_page_fails_by_what_a_job_wrote_in_place_of_numbers(console: Console, visitor: Visitor) -> None:
    small = {"cpus": 0.1, "memory": "64MiB"}
    spec = {"name": "broken", "train": {**SPEC["train"], "task": "nowhere:Task"}, "resources": small}
    answer = visitor.submit("/submit", yaml=json.dumps(spec))
    assert answer.status_code == 200, answer.text
    job = str(answer.json()["location"].rpartition("/")[2])
    await_status(console.client, job, "FAILED")
    run = Store(console.server.home / "store").run(console.client.get(f"/api/jobs/{job}")["run"])
    run.metrics.mkdir(exist_ok=True)
    paths = (
        *("/", f"/jobs/{job}", "/runs", f"/runs/{run.name}", f"/runs/{run.name}/curves"),
        *(f"/compare?run={run.name}", f"/compare/curves?run={run.name}", "/api/jobs", "/api/runs"),
    )
    wrong: list[Any] = []
    for value in ("text", [1, "x"], {"a": 1}, 10**300, 10**4000):
        records = [{"resumed_from": 0}, *({"iteration": i, **dict.fromkeys(NUMBERS, value)} for i in range(1, 6))]
        (run.metrics / "metrics-e1.jsonl").write_text("".join(json.dumps(each) + "\n" for each in records))
        wrong += [(str(value)[:9], path) for path in paths if visitor.http.get(path).status_code != 200]
    assert not wrong


def test_a_comparison_looks_for_few_patterns(console: Console) -> None:
    answer = console.visitor("reader").http.get(f"/compare?run={'+'.join(['a*'] * 41)}")
    assert answer.status_code == 400 and "at most 40" in answer.text


def test_a_form_searches_for_no_longer_text_than_the_page(console: Console) -> None:
    answer = console.visitor().submit("/jobs/stop", all="yes", search="%" * 70_000)
    assert answer.status_code == 400 and "more than 200 characters" in answer.json()["message"]


def test_one_key_has_a_hundred_streams_at_most_and_another_one_when_one_ends(console: Console) -> None:
    supplied = console.visitor("reader").http
    limits, address = httpx.Limits(max_connections=None), "/jobs/stream"
    with ExitStack() as stack, ExitStack() as one:
        http = stack.enter_context(
            httpx.Client(base_url=console.url, cookies=supplied.cookies, timeout=60, limits=limits)
        )

        def started() -> str:
            """The first event of another stream."""
            with http.stream("GET", address) as answer:
                return "".join(islice(answer.iter_lines(), 5))

        one.enter_context(http.stream("GET", address))
        for _ in range(99):
            stack.enter_context(http.stream("GET", address))
        refused = started()
        assert "event: trouble" in refused and "follows 100 logs and pages already" in refused
        one.close()
        wait_for(lambda: "event: parts" in started(), 30, "the place of the one that ended")


def test_those_who_wait_for_a_turn_are_few_and_the_others_are_refused_at_once() -> None:
    turns, started, over = Turns("busy", at_once=1, waiting=1), threading.Event(), threading.Event()

    def work() -> None:
        with turns.turn():
            started.set()
            over.wait()

    workers = [threading.Thread(target=work) for _ in range(2)]
    workers[0].start()
    started.wait()
    workers[1].start()
    try:
        while turns._admitted._value:  # the second one waits
            threading.Event().wait(0.01)
        with pytest.raises(ClientError, match="busy; try again"), turns.turn():
            pass
    finally:
        over.set()
        for each in workers:
            each.join()
    with turns.turn():
        pass


def test_no_directory_on_the_way_to_a_file_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "run" / "recordings" / "inner").mkdir(parents=True)
    (tmp_path / "run" / "recordings" / "inner" / "gait.gif").write_bytes(b"GIF89a")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "gait.gif").write_bytes(b"secret")
    with open_inside(tmp_path / "run", ["recordings", "inner", "gait.gif"]) as file:
        assert file.read() == b"GIF89a"
    (tmp_path / "run" / "recordings" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "run" / "recordings" / "gait.gif").symlink_to(tmp_path / "elsewhere" / "gait.gif")
    with pytest.raises(NotADirectoryError):
        open_inside(tmp_path / "run", ["recordings", "link", "gait.gif"])
    with pytest.raises(DamagedFile):
        open_inside(tmp_path / "run", ["recordings", "gait.gif"])
