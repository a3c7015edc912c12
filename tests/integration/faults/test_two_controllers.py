"""Two controllers on one store: each sees the other, and neither starts a run that the other is writing."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from orchestrator.control import peers
from orchestrator.control.peers import Peers
from orchestrator.domain.errors import ApiError
from shared_store.volume.epoch import Claim, raise_epoch, read_epoch
from shared_store.volume.layout import Store
from tests.conftest import Serving, wait_for
from tests.support.definitions import container, multinode

WAIT = "import os, time\nwhile not os.path.exists(os.environ['END']): time.sleep(0.05)"


def test_controllers_of_a_store_see_each_other_until_one_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(peers, "BEAT", 0.05)
    monkeypatch.setattr(peers, "GONE", 1.0)
    store = Store(tmp_path / "store").open()
    run = store.run("ant")
    first, second = Peers(store, tmp_path / "a"), Peers(store, tmp_path / "b")
    first.start()
    raise_epoch(run, 3, Claim(first.id, "0123456789", 2))
    second.start()
    wait_for(lambda: len(caplog.messages) == 2, 10, "a warning of each")
    for home, message in (("a", caplog.messages[0]), ("b", caplog.messages[1])):
        assert f"the controller of {tmp_path}/{home} on " in message
        assert f"(pid {os.getpid()}) uses the store" in message
    assert first.writer(run) is None, "its own attempt"
    output = second.writer(run) or ""
    assert output.startswith(f"job 01234567 (attempt 2) of the controller of {tmp_path}/a on ")
    first._ending.set()  # as if killed: its heartbeat stays, and grows no more
    wait_for(lambda: second.writer(run) is None, 20, "the first controller to count as gone")
    second.close()
    assert [path.stem for path in (store.path / "controllers").iterdir()] == [first.id]


def test_a_controller_that_started_since_the_last_look_is_found_by_its_claim(tmp_path: Path) -> None:
    store = Store(tmp_path / "store").open()
    first, second = Peers(store, tmp_path / "a"), Peers(store, tmp_path / "b")
    first.start()
    second.start()
    raise_epoch(store.run("ant"), 1, Claim(second.id, "job", 1))
    assert (first.writer(store.run("ant")) or "").startswith("job job (attempt 1) of the controller of ")
    raise_epoch(store.run("bee"), 1, Claim("../../escape", "job", 1))
    assert first.writer(store.run("bee")) is None
    first.close()
    second.close()


def test_a_heartbeat_of_a_controller_long_dead_is_cleared(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = Store(tmp_path / "store").open()
    (store.path / "controllers").mkdir()
    old = {"home": "/old", "host": "h", "pid": 1, "beat": 7, "time": time.time() - 90_000}
    (store.path / "controllers" / "0123.json").write_text(json.dumps(old))
    for name, content in {"list.json": "[]", "deep.json": "[" * 5000, "types.json": '{"home": 1, "pid": "x"}'}.items():
        (store.path / "controllers" / name).write_text(content)
    raise_epoch(store.run("ant"), 1, Claim("0123", "job", 1))
    here = Peers(store, tmp_path / "home")
    here.start()
    assert here.writer(store.run("ant")) is None and caplog.messages == []
    assert not (store.path / "controllers" / "0123.json").exists()
    here.close()


def test_a_second_controller_refuses_a_run_that_the_first_is_writing(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    options = ("--cpus", "4", "--store", str(store.path))
    end, free = {"END": str(tmp_path / "end")}, {"END": str(tmp_path / "free")}
    with Serving(tmp_path / "a", *options) as first, Serving(tmp_path / "b", *options) as second:
        earlier = second.gang(WAIT, env=free)
        needs = container(["python", "-c", WAIT], env={"MUSTER_RUN": "shared", **end})
        second.client.batch("RegisterJobDefinition", **multinode("after", needs))
        after = {"jobName": "after", "jobQueue": "default", "jobDefinition": "after", "dependsOn": [{"jobId": earlier}]}
        waiting = second.client.batch("SubmitJob", **after)["jobId"]
        writer = first.gang(WAIT, env={"MUSTER_RUN": "shared", **end}, name="writer")
        first.wait(writer, "RUNNING")
        assert read_epoch(store.run("shared")) == 1
        named = f"written by job {writer[:8]} (attempt 1) of the controller of {tmp_path}/a on "
        (tmp_path / "free").touch()  # the job that was accepted before learns it when it starts
        reason = second.wait(waiting)["statusReason"]
        assert reason.startswith("run shared is being " + named) and reason.endswith("stop that job first")
        with pytest.raises(ApiError) as refused:
            second.gang(WAIT, env={"MUSTER_RUN": "shared", **end})
        assert "run shared is being " + named in str(refused.value)
        assert first.detail(writer)["status"] == "RUNNING", "it was not fenced"
        (tmp_path / "end").touch()
        assert first.wait(writer)["status"] == "SUCCEEDED"
        next_ = second.gang("print('goes on')", env={"MUSTER_RUN": "shared"})
        assert second.wait(next_)["status"] == "SUCCEEDED" and read_epoch(store.run("shared")) == 2

        damaged = store.run("damaged")
        damaged.path.mkdir()
        (damaged.path / "EPOCH").write_text("99999999999999999999999\n")
        ended = second.wait(second.gang("pass", env={"MUSTER_RUN": "damaged"}))
        assert ended["status"] == "FAILED" and ended["statusReason"] == (
            f"store {store.path}: can't read run damaged: {damaged.path}/EPOCH: expected an integer of at most 15 "
            "digits, found '99999999999999999999999'"
        )
    assert second.process.stderr is not None
    reported = second.process.stderr.read()
    assert f"the controller of {tmp_path}/a on " in reported and "Traceback" not in reported
