"""The pages of the racer's tracks, through a real server."""

from __future__ import annotations

import xml.etree.ElementTree as xml

import pytest

from tests.support.console.fixtures import Console


def test_tracks_are_shown_with_their_outlines_and_measures(console: Console) -> None:
    visitor = console.visitor("reader")
    order = ("tracks", "make", "hills", "--seed", "7", "--length", "45")
    made = console.server.muster(*order, MUSTER_TOKEN=console.secrets["admin"])
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
    of_one = (f"/tracks/{name}{file}" for file in ("", "/outline.svg", "/picture.png"))
    for path in (*of_one, f"/tracks?name={name}"):
        answer = visitor.http.get(path)
        assert answer.status_code == 404 and "<script>alert" not in answer.text, path
    assert "did you mean oval?" in visitor.page("/tracks/ovall", 404).text


def test_the_api_lists_tracks_and_draws_them(console: Console) -> None:
    listed = console.client.get("/api/tracks")
    assert [each["name"] for each in listed][:3] == ["oval", "rounded-rectangle", "chicane"]
    assert "rings" not in listed[0]
    (drawn,) = console.client.get("/api/tracks", name="oval", rings="true")
    assert len(drawn["rings"]["inner"]) == len(drawn["rings"]["outer"]) == drawn["waypoints"]


def test_a_form_makes_a_track_for_good(console: Console) -> None:
    visitor = console.visitor()
    assert visitor.page("/tracks").all("form", action="/tracks", method="post")
    sent = {"name": "ring", "preset": "oval", "seed": "7", "length": "25", "width": "", "direction": "clockwise"}
    answer = visitor.submit("/tracks", **sent)
    assert answer.json() == {"location": "/tracks/ring", "message": "made track ring"}
    page = visitor.page("/tracks/ring")
    assert "Direction clockwise" in page.text and "preset oval" in page.text
    assert visitor.page("/tracks").all("img", alt="Outline of ring")
    again = visitor.submit("/tracks", **sent)
    assert again.status_code == 400 and "ring" in again.json()["message"]
    (drawn,) = console.client.get("/api/tracks", name="ring")
    assert drawn["origin"] == {"preset": "oval", "length": 25.0, "direction": "clockwise"}


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"length": "2"}, "length 2 m: expected 4 to 1000 m"),
        ({"length": "long"}, "length: expected a number, found a text ('long')"),
        ({"least_radius": "nan"}, "least_radius: expected a finite number"),
        ({"seed": "-1"}, "seed: expected a value greater than or equal to 0, found '-1'"),
        ({"seed": ""}, "give one of preset and seed"),
        ({"preset": "oval", "roughness": "0.5"}, "roughness belongs to seed"),
        ({"preset": "ovall"}, "did you mean oval?"),
        ({"name": "../out"}, "../out"),
        ({"name": "oval"}, "a preset is called so; choose another name"),
    ],
)
def test_a_track_that_can_t_be_made_is_refused_by_its_field(console: Console, wrong: dict[str, str], told: str) -> None:
    answer = console.visitor().submit("/tracks", **{"name": "wrong", "seed": "7", **wrong})
    assert answer.status_code == 400 and told in answer.json()["message"], answer.text
    assert "wrong" not in [each["name"] for each in console.client.get("/api/tracks")]


@pytest.mark.parametrize("key", ["reader", "lab"])
def test_only_a_writing_key_of_all_queues_makes_tracks(console: Console, key: str) -> None:
    visitor = console.visitor(key)
    assert not visitor.page("/tracks").all("form", action="/tracks", method="post")
    assert visitor.submit("/tracks", name="theirs", seed="7").status_code == 403
