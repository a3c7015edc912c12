"""What the silence of a node proves: its own end, the end of its network, or nothing."""

from __future__ import annotations

import pytest

from orchestrator.control.presence import Presence
from shared_store.contract.bus import Node

L = 120.0
"""``lost_after``."""
AGO = 0.5
"""Seconds since the engine was asked."""


class Cluster:
    """A controller with nodes of one gang each, at a time that the test sets."""

    def __init__(self, nodes: int, *, itself: bool = True) -> None:
        self.time = 1000.0
        self.presence = Presence(L, lambda: self.time, lambda: self.time)
        self.presence.hear_itself(itself)
        self.nodes: list[Node] = [(f"job-{index}", 1, 0) for index in range(nodes)]
        for node in self.nodes:
            self.presence.expect(node[0], 1, 1)
            self.presence.came(node)

    def silence(self, *indices: int) -> None:
        for index in indices:
            self.presence.left(self.nodes[index])

    def wait(self, seconds: float, *, answers: bool = True, runs: bool = True, cut: bool = False) -> None:
        """Let time pass, with a look at every node each second, as the controller has. ``cut``: nothing comes from any node."""
        for _ in range(int(seconds)):
            self.time += 1.0
            for node in self.nodes:
                if not cut:
                    self.presence.sent(node)
            self.lost(answers=answers, runs=runs)

    def lost(self, *, answers: bool = True, runs: bool = True) -> list[int]:
        found = [self.presence.silence(node, AGO if answers else None, runs) for node in self.nodes]
        return [index for index, silence in enumerate(found) if silence is not None and silence.is_lost]


def test_a_node_that_alone_is_silent_is_lost_after_its_time() -> None:
    cluster = Cluster(3)
    cluster.silence(1)
    cluster.wait(L)
    assert cluster.lost() == []
    cluster.wait(1)
    assert cluster.lost() == [1]
    silence = cluster.presence.silence(cluster.nodes[1], AGO)
    assert silence is not None and (silence.seconds, silence.since, silence.cause) == (121.0, "00:16:40 UTC", "")


@pytest.mark.parametrize(
    ("nodes", "itself", "silent", "cause"),
    [
        (1, False, [0], "the bus does not hear the controller either"),
        (2, True, [0, 1], "none of 2 nodes is heard, so the controller may be cut off"),
        (5, True, [0, 1, 2], "3 of 5 nodes fell silent within 10 s, so the controller seems to be cut off"),
    ],
)
def test_where_the_controller_may_be_cut_off_nodes_that_run_are_waited_for(
    nodes: int, itself: bool, silent: list[int], cause: str
) -> None:
    cluster = Cluster(nodes, itself=itself)
    cluster.silence(*silent)
    assert cluster.presence.cut_off is None, "at once it may be the end of a gang"
    cluster.wait(12)
    assert cluster.presence.cut_off == cause
    cluster.wait(50 * L)
    assert cluster.lost() == []
    silence = cluster.presence.silence(cluster.nodes[0], AGO)
    assert silence is not None and silence.cause == cause


@pytest.mark.parametrize("silent", [[0], [0, 1, 2]], ids=["alone", "with all others"])
def test_a_node_of_which_its_engine_can_t_tell_is_waited_for_five_times_as_long(silent: list[int]) -> None:
    cluster = Cluster(3)
    cluster.silence(*silent)
    cluster.wait(5 * L, runs=False)
    assert cluster.lost(runs=False) == []
    cluster.wait(1, runs=False)
    assert cluster.lost(runs=False) == silent


def test_only_a_fresh_answer_counts() -> None:
    cluster = Cluster(3)
    cluster.silence(1)
    cluster.wait(1)
    cluster.time += 2 * L
    silence = cluster.presence.silence(cluster.nodes[1], 50.0)
    assert silence is not None and not silence.is_lost


def test_where_gangs_that_are_launched_meanwhile_are_silent_too_the_router_s_own_voice_proves_nothing() -> None:
    cluster = Cluster(1)
    cluster.presence.expect("pulls its image", 1, 1)
    cluster.silence(0)
    cluster.wait(100)
    cluster.presence.expect("next", 1, 1)
    cluster.wait(300)
    assert cluster.lost() == [] and "launched since" in (cluster.presence.cut_off or "")
    cluster.presence.ended(("next", 1, 0))
    cluster.wait(L)
    assert cluster.lost() == []
    cluster.wait(1)
    assert cluster.lost() == [0], "by itself for its whole time"


def test_ten_minutes_of_outage_end_nothing_though_the_nodes_come_back_one_by_one() -> None:
    cluster = Cluster(8)
    for index in range(8):
        cluster.silence(index)
        cluster.wait(1)
    cluster.wait(600, answers=False)
    for index in range(7):
        cluster.presence.came(cluster.nodes[index])
        cluster.wait(10)
    assert cluster.lost() == []
    cluster.wait(L)
    assert cluster.lost() == [7], "the one that did not come back counts from when the others were heard again"


def test_a_router_that_removes_the_nodes_of_a_cut_network_one_by_one_ends_none() -> None:
    cluster = Cluster(60)
    for index in range(60):
        cluster.silence(index)
        cluster.wait(5, cut=True)
        assert cluster.lost() == []
    assert cluster.presence.cut_off == "none of 60 nodes is heard, so the controller may be cut off"
    cluster.presence.came(cluster.nodes[7])
    cluster.wait(L)
    assert cluster.lost() == []
    cluster.wait(1)
    assert cluster.lost() == [index for index in range(60) if index != 7]


def test_what_a_silent_node_sent_before_says_nothing_of_the_others() -> None:
    cluster = Cluster(2)
    cluster.silence(0)
    for _ in range(3 * int(L)):
        cluster.presence.sent(cluster.nodes[0])
        cluster.wait(1, cut=True)
    assert cluster.lost() == []
    cluster.wait(L + 1)
    assert cluster.lost() == []
    cluster.wait(1)
    assert cluster.lost() == [0], "from when the other was heard again"


def test_nodes_that_fall_silent_one_after_the_other_are_lost_each() -> None:
    cluster = Cluster(4)
    for index in range(3):
        cluster.silence(index)
        cluster.wait(11)
    assert cluster.presence.cut_off is None
    cluster.wait(L)
    assert cluster.lost() == [0, 1, 2]


def test_while_the_engine_does_not_answer_nothing_is_lost_and_its_time_does_not_count() -> None:
    cluster = Cluster(3)
    cluster.silence(1)
    cluster.wait(20 * L, answers=False)
    assert cluster.lost(answers=False) == []
    cluster.wait(L)
    assert cluster.lost() == []
    cluster.wait(1)
    assert cluster.lost() == [1]


def test_a_node_that_only_an_earlier_controller_met_is_unreachable_until_it_comes_and_never_lost() -> None:
    cluster, early, late, ended = Cluster(3), ("job-9", 1, 0), ("job-9", 1, 1), ("job-9", 1, 2)
    cluster.presence.expect("job-9", 1, 4, met=[0, 1, 2])
    cluster.presence.came(early)
    cluster.presence.ended(ended)
    cluster.wait(100 * L)
    cluster.presence.expect("job-9", 1, 4, met=[0, 1, 2])  # as after an outage of the database
    silence = cluster.presence.silence(late, AGO)
    assert silence is not None and (silence.seconds, silence.since, silence.is_lost) == (100 * L, "00:16:40 UTC", False)
    assert "has not come to this controller" in silence.cause
    assert not cluster.presence.met(late) and cluster.presence.cut_off is None
    for node in (early, ended, ("job-9", 1, 3)):
        assert cluster.presence.silence(node, AGO) is None
    cluster.presence.came(late)
    assert cluster.presence.silence(late, AGO) is None
    cluster.presence.left(late)
    cluster.wait(L + 1)
    assert (again := cluster.presence.silence(late, AGO)) is not None and again.is_lost


def test_a_gang_that_never_comes_to_the_bus_keeps_a_silent_node_from_being_lost_for_a_while_only() -> None:
    cluster = Cluster(1)
    cluster.silence(0)
    cluster.wait(1)
    cluster.presence.expect("job-9", 1, 1)
    cluster.wait(5 * L)
    assert cluster.lost() == []
    cluster.wait(L + 1)
    assert cluster.lost() == [0]


def test_nodes_of_no_open_attempt_are_not_noted() -> None:
    cluster = Cluster(1)
    for stranger in (("job-9", 1, 0), ("job-0", 2, 0), ("job-0", 1, 1), ("job-0", 1, -1)):
        cluster.presence.came(stranger)
        assert not cluster.presence.met(stranger)


def test_nodes_that_have_ended_do_not_make_the_controller_cut_off() -> None:
    cluster = Cluster(4)
    cluster.silence(0, 1, 2)
    cluster.wait(12)
    assert cluster.presence.cut_off is not None
    cluster.presence.ended(cluster.nodes[0])
    cluster.presence.forget("job-1", 1)
    assert cluster.presence.cut_off is None, "1 of 2 is silent"
    cluster.wait(L + 1)
    assert cluster.lost() == [2]
