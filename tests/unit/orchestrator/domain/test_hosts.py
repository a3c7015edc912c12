"""Machines and the capacity of engines; texts of others in bounded space; errors."""

from __future__ import annotations

import pytest

from orchestrator.domain.errors import NotServing
from orchestrator.domain.excerpts import excerpt
from orchestrator.domain.hosts import HERE, Host, Hosts, Limit, Placement, Queued, engine_of
from orchestrator.domain.job import NodeEnd
from orchestrator.domain.resources import EPSILON, Resources

MACHINE = Host("ray/a", 4, ("0", "1"), 1024)


def test_a_host_and_a_placement_have_an_amount_of_each_kind() -> None:
    assert MACHINE.resources == Resources(4, 2, 1024)
    assert Placement("ray/a", ("1",), 0.5, 64).resources == Resources(0.5, 1, 64)
    assert MACHINE.left(1, ("1",), 24) == Host("ray/a", 1, ("1",), 24)
    assert Resources(EPSILON) <= Resources(0) and not Resources(2 * EPSILON) <= Resources(0)
    assert not (MACHINE.single or MACHINE.unavailable or MACHINE.queue or MACHINE.machine)


def test_gangs_are_placed_on_machines_where_they_are_known_and_else_on_the_limit_of_the_queue() -> None:
    for capacity in (Hosts([MACHINE]), Queued([MACHINE])):
        assert list(capacity.machines) == list(capacity.places) == [MACHINE]
    limited = Queued(Limit("slurm/gpu", Resources(8, 2, 4096)))
    assert (limited.machines, limited.places) == ((), (Host("slurm/gpu", 8, ("0", "1"), 4096, queue=True),))


def test_a_host_is_named_after_its_engine_but_that_of_the_local_one() -> None:
    assert [engine_of(name) for name in (HERE, "ray/a/b", "docker/here", "/x")] == ["local", "ray", "docker", ""]
    assert HERE == "localhost"


@pytest.mark.parametrize(
    ("length", "most", "kept"), [(10, 10, None), (11, 10, 0), (100, 40, 16), (100, 25, 1), (100, 24, 0), (100, 5, 0)]
)
def test_a_long_text_is_cut_and_the_cut_is_counted(length: int, most: int, kept: int | None) -> None:
    text = "x" * length
    expected = text if kept is None else f"{text[:kept]} … ({length - kept} more characters)"
    assert excerpt(text, most) == expected


def test_the_reason_of_a_node_s_end_has_1024_characters_at_most() -> None:
    for length in (1024, 1025):
        reason = NodeEnd(1, "x" * length, 1.0).reason
        assert len(reason) <= 1024 and reason.endswith("x" if length == 1024 else "more characters)")


def test_a_refusal_has_its_words_and_its_status() -> None:
    error = NotServing("later", 503)
    assert (str(error), error.status) == ("later", 503)
