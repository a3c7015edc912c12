"""What Prometheus reads, parsed by its own library: a job that fails once, is retried and ends, and one that waits."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.conftest import REPOSITORY, Serving, wait_for

FAILS_ONCE = "import os, sys, time; time.sleep(0.5); sys.exit(os.environ['AWS_BATCH_JOB_ATTEMPT'] == '1')"

Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def scraped(server: Serving) -> Samples:
    answer = httpx.get(f"{server.url}/metrics")
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    found: Samples = {}
    for family in text_string_to_metric_families(answer.text):
        assert family.name.startswith("muster") and family.documentation and family.type != "unknown"
        for sample in family.samples:
            key = (sample.name, frozenset(sample.labels.items()))
            assert key not in found
            found[key] = sample.value
    return found


def value(found: Samples, name: str, **labels: str) -> float | None:
    return found.get((name, frozenset(labels.items())))


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Serving]:
    with Serving(tmp_path / "home", "--cpus", "1") as server:
        yield server


def test_a_scrape_reports_waiting_running_and_ended_jobs_and_their_use(small: Serving) -> None:
    before = scraped(small)
    assert value(before, "muster_jobs", queue="default", status="RUNNING") == 0
    assert value(before, "muster_database_usable") == 1 and value(before, "muster_volume_short", volume="store") == 0
    assert value(before, "muster_cpus", engine="local") == 1 and value(before, "muster_hosts", engine="local") == 1
    assert not [name for name, _ in before if name.startswith(("muster_restarts", "muster_attempts", "muster_cpu_s"))]

    gate = small.home / "gate"
    long = f"import os, time\nwhile not os.path.exists({str(gate)!r}): time.sleep(0.05)"
    first = small.gang(long, name="first", cpus="1")
    second = small.gang(FAILS_ONCE, name="second", env={"MUSTER_ON_CHILD_FAILURE": "restart"}, attempts=2, cpus="1")
    small.wait(first, "RUNNING")
    wait_for(lambda: value(scraped(small), "muster_jobs", queue="default", status="RUNNABLE") == 1)
    during = scraped(small)
    assert value(during, "muster_jobs", queue="default", status="RUNNING") == 1
    assert value(during, "muster_cpus_in_use", queue="default", engine="local") == 1
    assert value(during, "muster_gpus_in_use", queue="default", engine="local") == 0
    longest = value(during, "muster_queue_longest_wait_seconds", queue="default")
    assert longest is not None and 0 <= longest < 600

    gate.touch()
    small.wait(first)
    small.wait(second)
    after = scraped(small)
    own = {"queue": "default", "engine": "local"}
    assert value(after, "muster_jobs", queue="default", status="SUCCEEDED") == 2
    assert value(after, "muster_restarts_total", **own) == 1
    assert value(after, "muster_attempts_ended_total", **own, ending="succeeded") == 2
    assert value(after, "muster_attempts_ended_total", **own, ending="failed") == 1
    assert value(after, "muster_queue_wait_seconds_count", queue="default") == 2
    waited = value(after, "muster_queue_wait_seconds_sum", queue="default")
    assert waited is not None and waited >= longest  # the second one waited for the first
    shown = [json.loads(small.muster("show", job, "--json").stdout) for job in (first, second)]
    attempts = [attempt for each in shown for attempt in each["attempts"]]
    used, lost = (sum(attempt[key] for attempt in attempts) for key in ("cpuSeconds", "wastedCpuSeconds"))
    assert len(attempts) == 3 and used > lost > 0
    assert value(after, "muster_cpu_seconds_total", **own) == pytest.approx(used, abs=0.01)
    assert value(after, "muster_cpu_seconds_lost_total", **own) == pytest.approx(lost, abs=0.01)
    assert value(after, "muster_gpu_seconds_total", **own) == 0
    assert value(after, "muster_cpus_in_use", **own) is None
    assert (value(after, "muster_scheduling_pass_seconds_count") or 0) >= 2

    # what the dashboard shows is there; steps a second only while something trains
    existing = {name for found in (during, after) for name, _ in found}
    assert dashboard_requests() - existing == {"muster_training_steps_per_second"}


def dashboard_requests() -> set[str]:
    dashboard = json.loads((REPOSITORY / "containers/grafana.json").read_text())
    expressions = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    return {name for expression in expressions for name in re.findall(r"muster_\w+", expression)}


def test_every_metric_is_in_the_documentation_and_none_else(shared_server: Serving) -> None:
    page = (REPOSITORY / "docs/operations.md").read_text()
    text = httpx.get(f"{shared_server.url}/metrics").text
    families = set(re.findall(r"^# TYPE (muster_\w+) ", text, re.M)) - {"muster_info"}
    families -= {name for name in families if name.endswith("_created")}
    documented = set(re.findall(r"`(muster_\w+)`", page.partition("### Prometheus")[2].partition("\n## ")[0]))
    assert documented == families
