"""The tests that every engine passes, on Ray; and on all engines, those that take half a minute each."""

from __future__ import annotations

import pytest

from tests.conftest import wait_for
from tests.support.engines.every_engine import WAIT_FOR_ALL, EveryEngine, await_job_end
from tests.support.engines.fixtures import sites
from tests.support.engines.sites import SITES, Site
from tests.support.processes import freeze

site = sites("ray")
any_site = sites(*SITES)


class TestEveryEngine(EveryEngine):
    pass


def test_a_frozen_node_is_noticed_by_its_silence_and_its_gang_runs_again(any_site: Site) -> None:
    site = any_site
    if site.engine == "aws-batch":
        pytest.skip("nodes on AWS have no bus to the controller: there a frozen one is found by stall_timeout alone")
    job = site.submit(
        "echo ready; [ $AWS_BATCH_JOB_ATTEMPT = 2 ] || exec sleep 600" + WAIT_FOR_ALL, nodes=2, attempts=2
    )
    site.ready(job, 1, 2)
    # a node that was never on the bus is not missed there: it may be in a network that the bus does not reach
    wait_for(lambda: site.serving.detail(job)["attempts"][0]["nodes"][1].get("met"), 60, "node 1 on the bus")
    freeze(job, 1)
    detail = site.serving.wait(job, timeout=60)
    assert detail["status"] == "SUCCEEDED", (detail["statusReason"], site.serving.log(job)[-20:])
    assert "node 1 gives no sign of life for" in detail["attempts"][0]["statusReason"], detail["attempts"]
    await_job_end(job)
