"""The pages of tracks and leagues, through a real server."""

from __future__ import annotations

import re
import xml.etree.ElementTree as xml

import pytest

from shared_store.volume.evaluations import evaluation_name
from shared_store.volume.files import write_json
from shared_store.volume.layout import Store
from tests.support.console.fixtures import Console
from tests.support.console.visitor import Page, Visitor
from tests.support.console.wizard import HOSTILE
from tests.support.orchestrator.jobs import await_status
from tests.support.racer.leagues import race, summary
from tests.support.racer.racers import add_league, add_racer

# -- tracks ------------------------------------------------------------------------------------------------------------


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
def test_an_unknown_track_is_refused_with_the_nearest_name(visitor: Visitor, name: str) -> None:
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


def test_a_form_makes_a_track_for_good(console: Console, visitor: Visitor) -> None:
    assert visitor.page("/tracks").all("form", action="/tracks", method="post")
    sent = {"name": "ring", "preset": "oval", "seed": "7", "length": "25", "width": "", "direction": "clockwise"}
    answer = visitor.submit("/tracks", **sent)
    assert answer.json() == {"location": "/tracks/ring", "message": "made track ring"}
    page = visitor.page("/tracks/ring")
    assert "Direction clockwise" in page.text and "preset oval" in page.text
    assert visitor.page("/tracks").all("img", alt="Outline of ring")
    assert "ring" in visitor.refusal("/tracks", **sent, status=400)
    (drawn,) = console.client.get("/api/tracks", name="ring")
    assert drawn["origin"] == {"preset": "oval", "length": 25.0, "direction": "clockwise"}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"length": "2"}, "length 2 m: expected 4 to 1000 m"),
        ({"length": "long"}, "length: expected a number, found a string ('long')"),
        ({"least_radius": "nan"}, "least_radius: expected a finite number"),
        ({"seed": "-1"}, "seed: expected a value greater than or equal to 0, found '-1'"),
        ({"seed": ""}, "give one of preset and seed"),
        ({"preset": "oval", "roughness": "0.5"}, "roughness belongs to seed"),
        ({"preset": "ovall"}, "did you mean oval?"),
        ({"name": "../out"}, "../out"),
        ({"name": "oval"}, "a preset is called so; choose another name"),
    ],
)
def test_a_track_that_can_t_be_made_is_refused_by_its_field(
    console: Console, wrong: dict[str, str], message: str
) -> None:
    assert message in console.visitor().refusal("/tracks", **{"name": "wrong", "seed": "7", **wrong}, status=400)
    assert "wrong" not in [each["name"] for each in console.client.get("/api/tracks")]


@pytest.mark.parametrize("key", ["reader", "lab"])
def test_only_a_writing_key_of_all_queues_makes_tracks(console: Console, key: str) -> None:
    visitor = console.visitor(key)
    assert not visitor.page("/tracks").all("form", action="/tracks", method="post")
    assert visitor.submit("/tracks", name="theirs", seed="7").status_code == 403


# -- leagues -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def store(console: Console) -> Store:
    """With the league ``cup`` of two entries, three versions of the model ``fast``, and ``theirs`` of the queue ``lab``."""
    store = Store(console.server.home / "store")
    add_racer(store, "fast", "first", 5)
    add_racer(store, "fast", "second", 7, parent={"run": "first", "iteration": 5, "checkpoint": "x"})
    add_racer(store, "theirs", "of-lab", 2, "lab")
    add_racer(store, "fast", "second", 9)
    add_league(store, "cup", "ada", "bob")
    return store


def driven(page: Page) -> list[str]:
    """The jobs of the races that can be entered."""
    return [str(each["value"]) for each in page.all("input", name="job")]


def test_leagues_are_listed_with_their_rules_and_their_table(console: Console, store: Store) -> None:
    visitor = console.visitor("reader")
    page = visitor.page("/leagues")
    assert "cup" in page.text and "user ada" in page.text and page.all("form", action="/leagues") == []
    page = visitor.page("/leagues/cup")
    assert "ada fast@1 0:37.500 0:12.000 3 of 3 0 0 0 ranked" in page.text
    (drawn,) = page.all("img", alt="Outline of oval")
    assert visitor.http.get(str(drawn["src"])).headers["content-type"] == "image/svg+xml"
    assert "Ranked by the time of all laps" in page.text and "at most 99 entries of each key or user" in page.text
    assert [each for each in page.all("form", method="post") if each["action"] != "/logout"] == []
    laps = visitor.page("/leagues/cup/entries/1").text
    assert "Lap Time Penalty" in laps and "1 0:12.000 0 s 100.0 % 0 0 0 lap_complete" in laps
    assert "did you mean cup?" in visitor.page("/leagues/cub", 404).text
    assert visitor.http.get("/leagues/cup/entries/9").status_code == 404


def test_a_league_is_created_by_a_form_and_wrong_rules_are_refused(console: Console, store: Store) -> None:
    visitor = console.visitor()
    rules = {"name": "grand", "track": ["oval", "", " random:7 "], "laps": "4", "ranking": "best", "continuous": "true"}
    rules |= {"closes": "2999-01-01T00:00", "opens": "", "seed": "3", "off_track_penalty": "2.5"}
    answer = visitor.submit("/leagues", **rules)
    assert answer.json() == {"location": "/leagues/grand", "message": "created league grand"}
    page = visitor.page("/leagues/grand").text
    assert "oval, random:7" in page and "open until 2999-01-01 00:00:00 UTC" in page and "2.5 s off the track" in page
    for change, words in (
        ({"name": "x", "track": []}, "track"),
        ({"name": "x", "laps": "0"}, "laps"),
        ({"name": "x", "closes": "soon"}, "closes: expected a time such as"),
        ({"name": "x", "track": ["ovel"]}, "did you mean oval?"),
        ({"name": HOSTILE}, "use letters, digits"),
        ({}, "exists already"),
    ):
        assert words in visitor.refusal("/leagues", **{**rules, **change}, status=400)
    assert "is read-only" in console.visitor("reader").refusal("/leagues", **{**rules, "name": "other"})


def test_a_model_is_raced_and_its_race_entered_once_it_has_ended(console: Console, store: Store) -> None:
    visitor = console.visitor()
    assert [each for each in visitor.page("/leagues/cup").all("input", list="models")]
    assert "model fast does not exist" in console.visitor("lab").refusal("/leagues/cup/races", 404, model="fast@2")
    for model, words in (("", "model: choose one"), ("fast@x", "model: choose one"), ("fats", "did you mean fast?")):
        refused = visitor.submit("/leagues/cup/races", model=model)
        assert words in refused.json()["message"]
    started = visitor.submit("/leagues/cup/races", model="fast@2", racer="O'Neil").json()
    assert started["location"] == "/leagues/cup" and "submitted the race of fast@2" in started["message"]
    page = visitor.page("/leagues/cup")
    (link,) = [href for each in page.all("a") if re.match("/jobs/.", href := str(each.get("href")))]
    job = link.removeprefix("/jobs/")
    assert "Races that are not entered" in page.text and "fast@2" in page.text
    assert driven(page) == [], "it has not ended"
    early = visitor.submit("/leagues/cup/entries", model="fast@2", job=job)
    assert early.status_code == 409 and "only a race that has SUCCEEDED is entered" in early.json()["message"]
    stream = visitor.events("/leagues/cup/stream")
    _, first, _ = next(stream)
    assert first["races"]["order"] == [job] and "Enter" not in first["races"]["rows"][job]
    console.client.batch("TerminateJob", jobId=job, reason=HOSTILE)
    row = Page("")
    while "FAILED" not in row.text:
        row = Page(next(stream)[1].get("races", {"rows": {}})["rows"].get(job, row.source))
    assert HOSTILE in row.text and row.is_inert
    stream.close()
    await_status(console.client, job, "FAILED")
    page = visitor.page("/leagues/cup")
    assert HOSTILE in page.text and page.is_inert


def test_what_has_succeeded_is_entered_for_good(console: Console, visitor: Visitor, store: Store) -> None:
    registered = console.register("driven", "0.1")
    tags = {"muster:league": "cup", "muster:model": "fast@2"}
    fields = {"jobName": "race-cup-fast-2", "jobQueue": "default", "jobDefinition": registered, "tags": tags}
    job = str(console.client.batch("SubmitJob", **fields)["jobId"])
    await_status(console.client, job, "SUCCEEDED")
    path = store.run("second").evaluations / f"{evaluation_name('00000007-e1', job)}.json"
    write_json(path, summary(race([11.0, 11.5, 12.0]), job=job))
    page = visitor.page("/leagues/cup")
    assert driven(page) == [job]
    entered = visitor.submit("/leagues/cup/entries", model="fast@2", job=job, racer="O'Neil")
    assert entered.json() == {"location": "/leagues/cup/entries/3", "message": "entry 3 of cup"}
    page = visitor.page("/leagues/cup")
    assert "1 3 O'Neil fast@2 0:34.500" in page.text and driven(page) == []
    shown = visitor.page("/leagues/cup/entries/3")
    assert "are as they were entered" in shown.text and f"/jobs/{job}" in [each.get("href") for each in shown.all("a")]


def test_an_entry_is_disqualified_once_the_person_has_confirmed_it(console: Console, store: Store) -> None:
    visitor = console.visitor()
    path = "/leagues/cup/entries/2/disqualify"
    assert "reason" in visitor.submit(path, reason=" ").json()["message"]
    request = visitor.submit(path, reason=HOSTILE)
    assert request.status_code == 409 and request.json()["question"]["title"] == "Disqualify entry 2 of cup?"
    page = visitor.http.post(path, data={"form_token": visitor.page("/").form_token, "reason": HOSTILE})
    assert page.status_code == 409 and Page(page.text).is_inert and HOSTILE in Page(page.text).text
    for other in ("lab", "reader"):
        refused = console.visitor(other).submit(path, reason="x", confirmed="yes")
        assert refused.status_code == 403, other
    assert visitor.submit(path, reason=HOSTILE, confirmed="yes").json()["location"] == "/leagues/cup"
    page = visitor.page("/leagues/cup?every=yes")
    assert f"disqualified: {HOSTILE}" in page.text and page.is_inert
    assert visitor.page("/leagues/cup/entries/2").all("summary") == []


def test_a_race_is_listed_beside_many_newer_jobs_of_a_like_name(console: Console, store: Store) -> None:
    visitor = console.visitor()
    add_league(store, "tea")
    assert visitor.submit("/leagues/tea/races", model="fast@1").status_code == 200
    definition = console.register("waits")
    others = [console.submit(definition, f"race-tea-time-{i}") for i in range(21)]
    page = visitor.page("/leagues/tea")
    (job,) = [str(each["data-key"]) for each in page.all("tr") if "data-key" in each]
    for each in (job, *others):
        console.client.batch("TerminateJob", jobId=each, reason="seen")
