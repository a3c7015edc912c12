"""The tests that every engine passes, on Ray; and one test of half a minute, which runs on all engines at the same time.

Of faults and engines each pair is proven once: a rank, a supervisor and the controller that are killed by :class:`EveryEngine` on each
engine, a frozen node here (AWS's nodes have no bus to the controller: there it is found by ``stall_timeout`` alone), a node that a
training loses in ``test_every_training.py``. An engine does not see which algorithm trains: those training tests are PPO's, and the
pairs of algorithms and faults are proven on the local engine, in ``tests/long/faults``.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from tests.conftest import wait_for
from tests.support.engines.every_engine import WAIT_FOR_ALL, EveryEngine, await_job_end
from tests.support.engines.fixtures import sites
from tests.support.engines.sites import SITES, Site
from tests.support.processes import freeze, processes_of_job

site = sites("ray")
ON_THE_BUS = [name for name in SITES if name != "aws-batch"]


@pytest.fixture(scope="module")
def orphan(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A job on Ray that ended after its controller was killed."""
    with SITES["ray"](tmp_path_factory.mktemp("orphan"), request) as site:
        job = site.submit("echo ready; while [ ! -e $MUSTER_STORE/go ]; do sleep 0.05; done", nodes=1)
        site.ready(job, 1, 1)
        site.serving.kill()
        (site.volume / "go").touch()
        yield job


@pytest.mark.usefixtures("orphan")
class TestEveryEngine(EveryEngine):
    pass


@pytest.fixture(scope="module")
def frozen(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, tuple[Site, str] | pytest.skip.Exception]]:
    """By engine: the site and a gang whose node 1 is frozen, or the reason why the engine can't be tested here."""
    found: dict[str, tuple[Site, str] | pytest.skip.Exception] = {}
    with ExitStack() as stack:
        for name in ON_THE_BUS:
            try:
                site = stack.enter_context(SITES[name](tmp_path_factory.mktemp(name), request))
            except pytest.skip.Exception as missing:
                found[name] = missing
                continue
            script = "echo ready; [ $AWS_BATCH_JOB_ATTEMPT = 2 ] || exec sleep 600" + WAIT_FOR_ALL
            found[name] = site, site.submit(script, nodes=2, attempts=2)
        for site, job in (each for each in found.values() if isinstance(each, tuple)):
            site.ready(job, 1, 2)
            # a node that was never on the bus is not missed there: it may be in a network that the bus does not reach
            met = lambda site=site, job=job: site.serving.detail(job)["attempts"][0]["nodes"][1].get("met")  # noqa: E731
            wait_for(met, 60, "node 1 on the bus")
            freeze(job, 1)
        yield found


@pytest.mark.parametrize("engine", ON_THE_BUS)
def test_a_frozen_node_is_noticed_by_its_silence_and_its_gang_runs_again(
    frozen: dict[str, tuple[Site, str] | pytest.skip.Exception], engine: str
) -> None:
    if isinstance(frozen[engine], pytest.skip.Exception):
        raise frozen[engine]
    site, job = frozen[engine]
    detail = site.serving.wait(job, timeout=180)
    assert detail["status"] == "SUCCEEDED", (detail["statusReason"], site.serving.log(job)[-20:])
    assert "node 1 has been silent for" in detail["attempts"][0]["statusReason"], detail["attempts"]
    await_job_end(job)


def test_what_keeps_a_place_on_ray_leaves_when_no_controller_asks_any_more(orphan: str) -> None:
    wait_for(lambda: not processes_of_job(orphan), 100, "the driver's end")
