"""The tests that every engine passes, through a real controller: contract, order, ends, stops, kills, logs, and nothing left.

A module takes them by a class ``TestEveryEngine`` derived from :class:`EveryEngine`, and says by its fixture ``site`` on which engines.
"""

from __future__ import annotations

import json

import pytest

from tests.support.engines.sites import POLITE, Site
from tests.support.processes import command, kill_rank, kill_supervisor, processes_of_job
from tests.support.waiting import wait_for

CONTRACT = """python3 - <<'PYTHON'
import json, os
found = {name: value for name, value in os.environ.items() if name.startswith(("AWS_BATCH", "MUSTER_", "MASTER_", "NODE_", "NNODES"))}
found |= {name: os.environ[name] for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "GREETING", "CUDA_VISIBLE_DEVICES") if name in os.environ}
print(json.dumps(found))
PYTHON
for i in $(seq 200); do echo "line $i of $RANK"; done
"""
WAIT_FOR_ALL = """
mkdir -p $MUSTER_STORE/ends/$MUSTER_JOB_ID; touch $MUSTER_STORE/ends/$MUSTER_JOB_ID/$RANK
if [ $RANK = 0 ]; then while [ $(ls $MUSTER_STORE/ends/$MUSTER_JOB_ID | wc -l) -lt $WORLD_SIZE ]; do sleep 0.05; done; fi
"""
"""Last lines of a gang whose main node is done only when the others have come here, too."""
THIRD_TIME = "echo ready; [ $AWS_BATCH_JOB_ATTEMPT = 3 ] || exec sleep 600; while [ ! -e $MUSTER_STORE/go-$MUSTER_JOB_ID ]; do sleep 0.05; done; echo done"


def await_job_end(job: str) -> None:
    """No process of its nodes is left. A driver on Ray may stay for a while: it keeps the place for the job's next attempt."""

    def left() -> list[int]:
        return [pid for pid in processes_of_job(job) if "orchestrator.engines.ray.driver" not in command(pid)]

    wait_for(lambda: not left(), 30, "no process of the gang is left")


class EveryEngine:
    def test_a_gang_has_its_contract_to_the_letter_and_its_log_and_outcomes_are_whole(self, site: Site) -> None:
        greeting = "a 'b' \"c\" $d `e` \\f\n g"
        job = site.submit(CONTRACT + WAIT_FOR_ALL, nodes=3, GREETING=greeting)
        detail = site.serving.wait(job, timeout=120)
        assert detail["status"] == "SUCCEEDED", (detail["statusReason"], site.serving.log(job)[-20:])
        lines = site.printed(job)
        reported = {
            int(each["RANK"]): each for each in map(json.loads, (line for line in lines if line.startswith("{")))
        }
        assert sorted(reported) == [0, 1, 2] and len({frozenset(each) for each in (reported[1], reported[2])}) == 1
        address = "AWS_BATCH_JOB_MAIN_NODE_PRIVATE_IPV4_ADDRESS"
        assert address not in reported[0] and set(reported[1]) == {*reported[0], address}
        for rank, each in reported.items():
            found = [each[name] for name in ("GREETING", "WORLD_SIZE", "NNODES", "NODE_RANK")]
            assert found == [greeting, "3", "3", str(rank)]
            assert (each["AWS_BATCH_JOB_NODE_INDEX"], each["AWS_BATCH_JOB_NUM_NODES"]) == (str(rank), "3")
            assert each["AWS_BATCH_JOB_MAIN_NODE_INDEX"] == "0" and each["AWS_BATCH_JOB_ATTEMPT"] == "1"
            assert (each["MUSTER_JOB_ID"], each["MUSTER_RUN"]) == (job, detail["run"])
            assert (
                each["MASTER_ADDR"] == reported[0]["MUSTER_ADDRESS"]
                and each["MASTER_PORT"] == reported[0]["MASTER_PORT"]
            )
            grace = "25" if site.engine == "aws-batch" else "30"  # AWS itself kills after 30
            assert each["MUSTER_GRACE_SECONDS"] == grace
            assert each.get("CUDA_VISIBLE_DEVICES", "") == ""
            assert "MUSTER_TOKEN" not in each and "MUSTER_URL" not in each
            mine = [line for line in lines if line.endswith(f" of {rank}")]
            assert mine == [f"line {number} of {rank}" for number in range(1, 201)], "whole and in order"
        assert reported[1][address] == reported[0]["MUSTER_ADDRESS"]
        nodes = detail["attempts"][0]["nodes"]
        assert [node["exitCode"] for node in nodes] == [0, 0, 0] and all(node["reason"] == "done" for node in nodes)
        await_job_end(job)

    def test_a_gang_of_one_ends_with_its_exit_code_and_reason(self, site: Site) -> None:
        job = site.submit("echo one; exit 7", nodes=1)
        detail = site.serving.wait(job, timeout=60)
        assert detail["status"] == "FAILED" and "exited with code 7" in detail["statusReason"], detail["statusReason"]
        assert site.printed(job) == ["one"] and detail["attempts"][0]["nodes"][0]["exitCode"] == 7
        await_job_end(job)

    def test_where_the_outcome_can_t_be_written_the_exit_code_counts_that_the_engine_saw(self, site: Site) -> None:
        if site.engine == "aws-batch":
            pytest.skip("there the engine writes the outcome, from AWS's answer")
        link = "ln -s /tmp $MUSTER_STORE/runs/$MUSTER_RUN/outcomes"  # which is never followed
        detail = site.serving.wait(site.submit(link, nodes=1), timeout=60)
        [node] = detail["attempts"][0]["nodes"]
        assert (detail["status"], node["exitCode"]) == ("SUCCEEDED", 0), (detail["statusReason"], node)
        assert node["reason"].startswith("exit 0, outcome not written"), node

    def test_one_that_does_not_fit_waits_and_says_why(self, site: Site) -> None:
        job = site.submit("true", nodes=2, cpus="100000")
        found = lambda: (d := site.serving.detail(job)) and "100000 CPUs" in (d["statusReason"] or "") and d  # noqa: E731
        waiting = wait_for(found, 30, "why")
        assert waiting["status"] == "RUNNABLE" and not waiting["attempts"]
        site.serving.client.batch("TerminateJob", jobId=job, reason="enough")
        assert site.serving.wait(job)["statusReason"] == "enough"

    def test_asked_to_leave_it_saves_within_its_grace(self, site: Site) -> None:
        job = site.submit(POLITE, nodes=2)
        site.ready(job, 1, 2)
        site.serving.client.batch("TerminateJob", jobId=job, reason="that will do")
        detail = site.serving.wait(job, timeout=60)
        assert detail["status"] == "FAILED" and detail["statusReason"].startswith("that will do")
        assert [node["exitCode"] for node in detail["attempts"][0]["nodes"]] == [75, 75]
        assert site.printed(job).count("saved") == 2
        await_job_end(job)

    def test_what_is_killed_is_started_again_and_the_controller_may_die_meanwhile(self, site: Site) -> None:
        job = site.submit(THIRD_TIME + WAIT_FOR_ALL, nodes=2, attempts=3)
        site.ready(job, 1, 2)
        kill_rank(job, 1)
        site.ready(job, 2, 2)
        kill_supervisor(job, 1)
        site.ready(job, 3, 2)
        site.serving.kill()
        (site.volume / f"go-{job}").touch()
        await_job_end(job)
        site.serving.start()
        detail = site.serving.wait(job, timeout=60)
        assert detail["status"] == "SUCCEEDED", (detail["statusReason"], site.serving.log(job)[-20:])
        first, second, third = detail["attempts"]
        assert "rank 1 was killed by SIGKILL" in first["statusReason"], first
        assert second["spent"] and second["nodes"][1]["exitCode"] != 0, second
        assert third["exitCode"] == 0 and site.printed(job, 3).count("done") == 2
