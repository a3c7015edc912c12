"""Amounts, machines and the capacity of engines; texts of others in bounded space; errors."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.domain.excerpts import excerpt
from orchestrator.domain.hosts import HERE, Host, Hosts, Limit, Placement, Queued, engine_of
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


amounts = st.builds(Resources, st.integers(0, 640).map(lambda n: n / 8), st.integers(0, 16), st.integers(0, 10**6))
"""CPUs in eighths, which floats hold exactly."""


def test_amounts_are_added_and_subtracted_kind_by_kind() -> None:
    some, more = Resources(1.5, 2, 512), Resources(0.25, 1, 100)
    assert some + more == Resources(1.75, 3, 612)
    assert some - more == Resources(1.25, 1, 412)
    assert more - some == Resources(-1.25, -1, -412)


@pytest.mark.parametrize(
    ("requested", "free", "fits"),
    [
        (Resources(2, 1, 100), Resources(2, 1, 100), True),
        (Resources(2, 0, 100), Resources(4, 1, 200), True),
        (Resources(2.5, 0, 100), Resources(2, 8, 200), False),
        (Resources(1, 2, 100), Resources(2, 1, 200), False),
        (Resources(1, 1, 201), Resources(2, 1, 200), False),
        (Resources(0.1, 0, 1), Resources(0.3 - 0.1 - 0.1, 0, 1), True),  # less than 0.1, as floats round
    ],
)
def test_an_amount_fits_where_there_is_enough_of_every_kind(requested: Resources, free: Resources, fits: bool) -> None:
    assert (requested <= free) is fits and (free >= requested) is fits


@given(amounts, amounts)
def test_allocating_and_releasing_restores_the_free_resources(present: Resources, taken: Resources) -> None:
    assert present - taken + taken == present and taken <= present + taken
    assert (taken <= present) == (Resources() <= present - taken)
