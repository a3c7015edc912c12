"""Amounts of CPUs, GPUs and memory."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.domain.hosts import Host, Placement
from orchestrator.domain.resources import Resources

amounts = st.builds(Resources, st.integers(0, 640).map(lambda n: n / 8), st.integers(0, 16), st.integers(0, 10**6))
"""CPUs in eighths, which floats hold exactly."""


def test_amounts_are_added_and_subtracted_kind_by_kind_and_gpus_are_counted() -> None:
    some, more = Resources(1.5, 2, 512), Resources(0.25, 1, 100)
    assert some + more == Resources(1.75, 3, 612)
    assert some - more == Resources(1.25, 1, 412)
    assert more - some == Resources(-1.25, -1, -412)
    assert Host("a", 4.0, ("0", "1"), 1024).resources == Resources(4.0, 2, 1024)
    assert Host("a", 4.0, ("0", "1"), 1024).left(1.0, ("1",), 24).resources == Resources(1.0, 1, 24)
    assert Placement("a", ("1",), 0.5, 100).resources == Resources(0.5, 1, 100)


@pytest.mark.parametrize(
    ("asked", "free", "fits"),
    [
        (Resources(2, 1, 100), Resources(2, 1, 100), True),
        (Resources(2, 0, 100), Resources(4, 1, 200), True),
        (Resources(2.5, 0, 100), Resources(2, 8, 200), False),
        (Resources(1, 2, 100), Resources(2, 1, 200), False),
        (Resources(1, 1, 201), Resources(2, 1, 200), False),
        (Resources(0.1, 0, 1), Resources(0.3 - 0.1 - 0.1, 0, 1), True),  # less than 0.1, as floats round
    ],
)
def test_an_amount_fits_where_there_is_enough_of_every_kind(asked: Resources, free: Resources, fits: bool) -> None:
    assert (asked <= free) is fits and (free >= asked) is fits


@given(amounts, amounts)
def test_allocating_and_releasing_restores_the_free_resources(there: Resources, taken: Resources) -> None:
    assert there - taken + taken == there and taken <= there + taken
    assert (taken <= there) == (Resources() <= there - taken)
