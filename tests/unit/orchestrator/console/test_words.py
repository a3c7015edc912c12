"""Numbers, times and attributes of the console's pages."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from orchestrator.console import words

DURATIONS = {
    None: "",
    -3: "0 s",
    59.9: "59 s",
    60: "1 min",
    3600: "1 h",
    3660: "1 h 1 min",
    86400: "1 d",
    90061: "1 d 1 h",
}
NUMBERS = {None: "", 0: "0", 12: "12", 3.4567: "3.46", -0.01234: "-0.0123", 1234.5: "1234", 18_240: "18.2 k"}
NUMBERS |= {1_070_000: "1.07 M", -2.5e10: "-25.0 G"}


def test_a_duration_has_its_two_largest_units_and_a_number_three_or_four_digits_and_a_unit() -> None:
    assert {seconds: words.duration(seconds) for seconds in DURATIONS} == DURATIONS
    assert {value: words.count(value) for value in NUMBERS} == NUMBERS


@given(st.lists(st.floats(-1e12, 1e12), min_size=2, max_size=60))
def test_the_points_of_a_curve_stay_in_their_box_and_keep_their_order(values: list[float]) -> None:
    points = [tuple(map(float, each.split(","))) for each in words.spark(values).split()]
    assert len(points) == len(values)
    assert all(0 <= x <= 100 and 0 <= y <= 24 for x, y in points)
    assert points == sorted(points, key=lambda point: point[0])


def test_a_curve_of_equal_values_is_flat_and_a_time_is_written_and_read_again() -> None:
    assert words.spark([1.0]) == "" and {each.partition(",")[2] for each in words.spark([2, 2, 2]).split()} == {"22.0"}
    assert words.moment(1_700_000_000_000) == "2023-11-14T22:13:20+00:00"
    assert words.moment(None) == words.since("") == "" and words.since("2023-11-14T22:13:20+00:00").endswith(("d", "h"))


def test_an_attribute_shows_its_field_escaped_and_names_it_for_scripts() -> None:
    row = {"link": '/"><script>', "name": "x", "open": "", "done": 0}
    assert words.bound(row, href="link", text="name", hidden="open", value="done") == (
        'data-bind="href:link text:name hidden:open value:done" href="/&#34;&gt;&lt;script&gt;" hidden value="0"'
    )
