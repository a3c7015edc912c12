"""The pages of the racer's tracks, through a real server."""

from __future__ import annotations

import xml.etree.ElementTree as xml

import pytest

from tests.conftest import run_muster
from tests.support.console.fixtures import Console


def test_tracks_are_shown_with_their_outlines_and_measures(console: Console) -> None:
    visitor = console.visitor("reader")
    order = ("tracks", "make", "hills", "--seed", "7", "--length", "45")
    made = run_muster(*order, home=console.server.home, MUSTER_TOKEN=console.secrets["admin"])
    assert made.returncode == 0, made.stderr
    page = visitor.page("/tracks")
    pictures = [str(each["src"]) for each in page.all("img")]
    assert pictures == [f"/tracks/{name}/outline.svg" for name in ("oval", "rounded-rectangle", "chicane", "hills")]
    assert "Length 45.00 m" in page.text
    for path in (*pictures, "/tracks/random%3A7/outline.svg"):
        answer = visitor.http.get(path)
        assert answer.headers["content-type"] == "image/svg+xml", path
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        road, start = xml.fromstring(answer.text)
        assert str(road.get("d")).count("Z") == 2 and str(start.get("d")).count("L") == 1


def test_a_track_has_its_facts_and_the_picture_of_the_command(console: Console) -> None:
    visitor = console.visitor("lab")
    page = visitor.page("/tracks?name=random:7")
    assert "Length 30.00 m" in page.text and "Waypoints" in page.text and "Digest" in page.text
    (picture,) = page.all("img")
    answer = visitor.http.get(str(picture["src"]))
    assert answer.headers["content-type"] == "image/png" and answer.content.startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["ovall", "random:x", "<script>alert(1)</script>", "..%2f..%2fetc", "-o"])
def test_an_unknown_track_is_told_with_the_nearest_name(console: Console, name: str) -> None:
    visitor = console.visitor()
    for path in (
        f"/tracks/{name}",
        f"/tracks/{name}/outline.svg",
        f"/tracks/{name}/picture.png",
        f"/tracks?name={name}",
    ):
        answer = visitor.http.get(path)
        assert answer.status_code == 404 and "<script>alert" not in answer.text, path
    assert "did you mean oval?" in visitor.page("/tracks/ovall", 404).text


def test_the_api_lists_tracks_and_draws_them(console: Console) -> None:
    listed = console.client.get("/api/tracks")
    assert [each["name"] for each in listed][:3] == ["oval", "rounded-rectangle", "chicane"] and "rings" not in listed[
        0
    ]
    (drawn,) = console.client.get("/api/tracks", name="oval", rings="true")
    assert len(drawn["rings"]["inner"]) == len(drawn["rings"]["outer"]) == drawn["waypoints"]
