"""The pages of leagues, through a real server."""

from __future__ import annotations

import re

import pytest

from shared_store.evaluations import evaluation_name
from shared_store.files import write_json
from shared_store.layout import Store
from tests.support.console.fixtures import Console
from tests.support.console.racers import add_league, add_racer
from tests.support.console.visitor import Page
from tests.support.orchestrator.jobs import await_status
from tests.support.shared_store.leagues import race, summary

HOSTILE = "'<script>alert(1)</script>"


@pytest.fixture(scope="module")
def store(console: Console) -> Store:
    """A model ``fast`` of two versions, and the league ``cup`` with two entries."""
    store = Store(console.server.home / "store")
    add_racer(store, "fast", "racer", 5)
    add_racer(store, "fast", "racer", 7)
    add_league(store, "cup", "ada", "bob")
    return store


def driven(page: Page) -> list[str]:
    """The jobs of the races that can be entered."""
    forms = page.all("form", action="/leagues/cup/entries")
    jobs = [str(each.get("value", "")) for each in page.all("input", name="job")]
    return [job for form, job in zip(forms, jobs, strict=True) if "hidden" not in form]


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


def test_a_league_is_created_by_a_form_and_wrong_rules_are_told(console: Console, store: Store) -> None:
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
        refused = visitor.submit("/leagues", **{**rules, **change})
        assert refused.status_code == 400 and words in refused.json()["message"], (change, refused.text)
    reader = console.visitor("reader").submit("/leagues", **{**rules, "name": "other"})
    assert reader.status_code == 403 and "is read-only" in reader.json()["message"]


def test_a_model_is_raced_and_its_race_entered_once_it_has_ended(console: Console, store: Store) -> None:
    visitor = console.visitor()
    assert [each for each in visitor.page("/leagues/cup").all("input", list="models")]
    lab = console.visitor("lab").submit("/leagues/cup/races", model="fast@2")
    assert lab.status_code == 403 and "may use job queue lab only" in lab.json()["message"]
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
    assert first["order"] == [job] and first["rows"][job]["driven"] == ""
    console.client.batch("TerminateJob", jobId=job, reason=HOSTILE)
    changed: dict[str, str] = {}
    while changed.get("status") != "FAILED":
        changed |= next(stream)[1].get("rows", {}).get(job, {})
    assert changed["reason"] == HOSTILE
    stream.close()
    await_status(console.client, job, "FAILED")
    page = visitor.page("/leagues/cup")
    assert HOSTILE in page.text and page.is_inert


def test_what_has_succeeded_is_entered_for_good(console: Console, store: Store) -> None:
    visitor = console.visitor()
    registered = console.register("driven", "0.1")
    tags = {"muster:league": "cup", "muster:model": "fast@2"}
    given = {"jobName": "race-cup-fast-2", "jobQueue": "default", "jobDefinition": registered, "tags": tags}
    job = str(console.client.batch("SubmitJob", **given)["jobId"])
    await_status(console.client, job, "SUCCEEDED")
    path = store.run("racer").evaluations / f"{evaluation_name('00000007-e1', job)}.json"
    write_json(path, summary(race([11.0, 11.5, 12.0]), job=job))
    page = visitor.page("/leagues/cup")
    assert driven(page) == [job]
    entered = visitor.submit("/leagues/cup/entries", model="fast@2", job=job, racer="O'Neil")
    assert entered.json() == {"location": "/leagues/cup/entries/3", "message": "entry 3 of cup"}
    page = visitor.page("/leagues/cup")
    assert "1 3 O'Neil fast@2 0:34.500" in page.text and driven(page) == []
    shown = visitor.page("/leagues/cup/entries/3")
    assert "are as they were entered" in shown.text and f"/jobs/{job}" in [each.get("href") for each in shown.all("a")]


def test_an_entry_is_disqualified_once_the_person_has_said_yes(console: Console, store: Store) -> None:
    visitor = console.visitor()
    path = "/leagues/cup/entries/2/disqualify"
    assert "reason" in visitor.submit(path, reason=" ").json()["message"]
    asked = visitor.submit(path, reason=HOSTILE)
    assert asked.status_code == 409 and asked.json()["question"]["title"] == "Disqualify entry 2 of cup?"
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
    (job,) = [str(each.get("value")) for each in page.all("input", name="job") if each.get("value")]
    for each in (job, *others):
        console.client.batch("TerminateJob", jobId=each, reason="seen")
