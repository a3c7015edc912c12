"""The suite of tests that every engine passes by itself, without a controller.

A test module derives a class whose name begins with ``Test`` from :class:`EngineSuite`, and gives it a fixture ``rig``::

    class TestMine(EngineSuite):
        @pytest.fixture
        def rig(self, tmp_path):
            with ShellRig(tmp_path / "store", lambda: MyEngine(tmp_path)) as rig:
                yield rig

A limit of a wait only ends a test that hangs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from orchestrator.domain.hosts import engine_of
from orchestrator.engines.api import GangStatus, Handle, NodePhase, NodeStatus, NotYet, read_handle
from orchestrator.engines.testing.rigs import Rig
from orchestrator.engines.toolkit.statuses import status_of
from orchestrator.engines.toolkit.waiting import wait_until

LIMIT = 120.0
"""Seconds after which a test fails that waits for an engine."""
_TAKEN = (0, 3, 75)
"""Exit codes that nodes leave with."""


class EngineSuite:
    """See the module; each test has a rig of its own."""

    def test_its_hosts_have_names_of_their_own_that_say_whose_they_are(self, rig: Rig) -> None:
        capacity = rig.engine.capacity()
        assert type(rig.new_engine().capacity()) is type(capacity), "an engine either has hosts or queues, for good"
        hosts = capacity.places
        names = [host.name for host in hosts]
        assert names and len(set(names)) == len(names), f"hosts {names}: at least one, and no name twice"
        for host in hosts:
            assert engine_of(host.name) == rig.engine.name, f"host {host.name}: expected {rig.engine.name}/<its name>"
            assert host.cpus > 0 and host.memory > 0, f"{host} has nothing"

    def test_a_plan_is_the_same_each_time_and_tells_every_node_its_contract(self, rig: Rig) -> None:
        gang = rig.gang("planned", 2)
        plan = rig.engine.plan(gang)
        assert plan == rig.engine.plan(gang), "a plan depends on nothing but the gang and the machines"
        assert [node.contract.node_index for node in plan.nodes] == [0, 1]
        for index, node in enumerate(plan.nodes):
            contract = node.contract
            assert (contract.gang, contract.node_count, contract.main_index) == (gang.name, 2, 0)
            assert (contract.run, contract.epoch) == (gang.run, gang.epoch)
            assert list(node.command) == list(gang.nodes[index].command), "the job's own command"
            assert dict(node.environment) == dict(gang.nodes[index].environment), "the job's own environment"

    def test_every_node_runs_and_ends_with_its_own_exit_code(self, rig: Rig) -> None:
        handle = launch(rig, "codes", len(_TAKEN))
        for index, code in reversed([*enumerate(_TAKEN)]):  # the main node last: its end may end the others
            rig.end(handle, index, code)
            status = await_node(rig, handle, index, NodePhase.ENDED)
            assert rig.exit_code(handle, index, status) == code, f"node {index}: {status}, expected exit code {code}"

    def test_a_second_launch_finds_what_the_first_has_started(self, rig: Rig) -> None:
        handle = launch(rig, "twice", 2)
        again = rig.engine.launch(rig.engine.plan(rig.gang("twice", 2)))
        assert again == handle, "the same handle, and nothing started twice"
        successor = rig.new_engine()
        found = started(lambda: successor.launch(successor.plan(rig.gang("twice", 2))))
        assert found == handle, "nor by the controller that follows"

    def test_a_gang_outlives_its_controller_and_the_next_one_finds_it_by_the_text_of_its_handle(self, rig: Rig) -> None:
        handle = launch(rig, "outlives", 2)
        successor = rig.new_engine()
        rig.engine.close()
        rig.engine = successor
        found = read_handle(handle.text())
        assert (found, found.engine) == (handle, successor.name)
        for index in range(2):
            await_node(rig, found, index, NodePhase.RUNNING)
        successor.stop(found, 1.0)
        assert not any(node.running for node in status_of(successor, found))

    def test_a_stop_leaves_nothing_that_runs_and_may_be_asked_for_again(self, rig: Rig) -> None:
        handle = launch(rig, "stopped", 2)
        for _ in range(2):
            rig.engine.stop(handle, 1.0)
            status = status_of(rig.engine, handle)
            assert [node.phase for node in status] == [NodePhase.ENDED] * 2, status

    def test_stopping_one_gang_leaves_the_others_alone(self, rig: Rig) -> None:
        first, second = launch(rig, "first", 1), launch(rig, "second", 1)
        rig.engine.stop(first, 1.0)
        assert [node.running for node in status_of(rig.engine, second)] == [True]
        assert [node.running for node in status_of(rig.engine, first)] == [False]

    def test_gangs_are_stopped_on_other_threads_while_they_are_looked_at(self, rig: Rig) -> None:
        handles = [launch(rig, f"beside-{number}", 1) for number in range(3)]
        with ThreadPoolExecutor(len(handles)) as pool:
            stops = [pool.submit(rig.engine.stop, handle, 1.0) for handle in handles]
            while not all(stop.done() for stop in stops):
                assert all(len(status_of(rig.engine, handle)) == 1 for handle in handles)
        for stop in stops:
            stop.result()
        assert not any(node.running for handle in handles for node in status_of(rig.engine, handle))

    def test_an_engine_that_was_never_used_can_be_closed(self, rig: Rig) -> None:
        rig.new_engine().close()


def started(launch: Callable[[], Handle]) -> Handle:
    """Ask again, as a controller does, while the launch has to wait."""
    deadline = time.monotonic() + LIMIT
    while True:
        try:
            return launch()
        except NotYet:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def launch(rig: Rig, name: str, nodes: int) -> Handle:
    """Start a gang and wait until all of its nodes run."""
    plan = rig.engine.plan(rig.gang(name, nodes))
    handle = started(lambda: rig.engine.launch(plan))
    assert (handle.engine, handle.gang, handle.nodes) == (rig.engine.name, plan.gang.name, nodes), handle
    for index in range(nodes):
        await_node(rig, handle, index, NodePhase.RUNNING)
    return handle


def await_node(rig: Rig, handle: Handle, index: int, phase: NodePhase) -> NodeStatus:
    """Wait until the node is in that phase."""
    status: GangStatus = ()

    def exists() -> bool:
        nonlocal status
        status = status_of(rig.engine, handle)
        assert len(status) == handle.nodes, f"{len(status)} nodes of {handle.nodes}"
        return status[index].phase is phase

    assert wait_until(exists, LIMIT), f"node {index} is not {phase} within {LIMIT:g} s: {status}"
    return status[index]
