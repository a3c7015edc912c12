"""The pages of leagues: rules, the table, entries, and a race of a model by the rules of one."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from functools import partial
from typing import Any

from fastapi import Depends, Query, Request, Response

from orchestrator.api.batch import operations as batch
from orchestrator.api.http.requests import actor_of, controller_of
from orchestrator.api.native.job_list import JobSelection, page_of_jobs
from orchestrator.api.native.model_routes import list_models
from orchestrator.console.forms import Form, Question, body_of, done, sent_form
from orchestrator.console.live import LiveParts, Recent, Table, stream
from orchestrator.console.pages import render
from orchestrator.console.routing import page_router
from orchestrator.domain.errors import ClientError
from racer.control import leagues as cases
from racer.control.leagues import LEAGUE_TAG, MODEL_TAG
from racer.control.submit_form import FORM
from racer.control.track_pages import OUTLINE, track_names
from racer.store.leagues import moment
from racer.store.races import clock
from racer.store.standings import RANKINGS
from shared_store.contract.error_text import counted

router = page_router(stored=True)

_RACES = 20
"""Number of races under way, or over and not entered, on a league's page."""
_READ = 100
"""Jobs among which they are looked for: those of a name like its races', also entered ones and those of leagues with a longer name."""
_INTERVAL = 2.0
"""Seconds between two looks at them; each reads all entries."""
_recent = Recent(_INTERVAL * 0.9)


@router.get("/leagues")
def leagues(request: Request) -> Response:
    """All leagues, and a form for another one."""
    tracks, missing = track_names(request)
    found = [
        {"name": each["name"], "problem": each.get("problem", ""), **_shown(each)}
        for each in cases.list_leagues(controller_of(request))
    ]
    return render(
        request, "leagues.html", leagues=found, tracks=tracks, no_tracks=missing, rankings=RANKINGS, outline=OUTLINE
    )


@router.post("/leagues")
def create(request: Request, form: Form = Depends(sent_form)) -> Response:
    """Create a league; its rules are never changed."""
    fields: dict[str, Any] = {key: form.one(key) for key in form.fields if key in cases.CreateRequest.model_fields}
    fields = {key: value.strip() for key, value in fields.items() if value.strip()}
    fields |= {key: _moment(key, fields[key]) for key in ("opens", "closes") if key in fields}
    fields["track"] = [each.strip() for each in form.every("track") if each.strip()]
    body = body_of(cases.CreateRequest, {"name": "", **fields})
    league = cases.create_league(controller_of(request), actor_of(request), body)
    return done(request, f"/leagues/{league['name']}", f"created league {league['name']}")


@router.get("/leagues/{name}")
def league(request: Request, name: str, every: bool = Query(default=False)) -> Response:
    """The rules, the table, and races that are not entered yet."""
    found = cases.read_league(controller_of(request), name)
    if "problem" in found:
        raise ClientError(found["problem"], 409)
    rows = [
        {**row, "time": clock(row["time"]), "best_lap": clock(row["best_lap"])}
        for row in cases.league_table(controller_of(request), name, every=every)
    ]
    models = [
        f"{each['name']}@{each['version']}" for each in list_models(request) if FORM.includes(str(each.get("task")))
    ]
    return render(
        request,
        "league.html",
        league=found,
        rules=list(_rules(found).items()),
        state=_shown(found)["state"],
        rows=rows,
        every=every,
        models=models,
        races=_races(request, name),
    )


@router.get("/leagues/{name}/stream")
def race_stream(request: Request, name: str) -> Response:
    """The changes in the list of races, as events."""
    actor = actor_of(request)
    look = partial(_races, request, name)
    live = LiveParts(request, "league_live.html", league=cases.read_league(controller_of(request), name))
    return stream(request, lambda: live.changes({"races": _recent.get((actor, name), look)}), _INTERVAL, stored=True)


@router.post("/leagues/{name}/races")
def race(request: Request, name: str, form: Form = Depends(sent_form)) -> Response:
    """Submit the race of a model."""
    started = cases.race(controller_of(request), actor_of(request), name, body_of(cases.RaceRequest, _racer(form)))
    reference = f"{started['model']}@{started['version']}"
    message = f"submitted the race of {reference} as {started['jobId'][:8]}; enter it here when it has ended"
    return done(request, f"/leagues/{name}", message)


@router.post("/leagues/{name}/entries")
def enter(request: Request, name: str, form: Form = Depends(sent_form)) -> Response:
    """Make an entry of a race that has ended, for good."""
    entry = cases.enter(
        controller_of(request),
        actor_of(request),
        name,
        body_of(cases.EnterRequest, {**_racer(form), "job": form.one("job")}),
    )
    return done(request, f"/leagues/{name}/entries/{entry['entry']}", f"entry {entry['entry']} of {name}")


@router.get("/leagues/{name}/entries/{number}")
def entry(request: Request, name: str, number: int) -> Response:
    """An entry with its laps, and whether it and its model are unchanged since."""
    found = cases.read_entry(controller_of(request), actor_of(request), name, number)
    trials = [
        {**each, "time": clock(each.get("time")), "penalty": f"{each.get('penalty') or 0:g} s"}
        for each in (found.get("race") or {}).get("trials") or ()
    ]
    model, evaluation = found.get("model") or {}, found.get("evaluation") or {}
    facts = {
        "Racer": found.get("racer"),
        "Owner": found.get("owner"),
        "Entered": moment(found["entered"]) if "entered" in found else "",
        "Evaluation": f"{evaluation.get('name')} of run {evaluation.get('run')}" if evaluation else "",
        "Digest of the model": model.get("digest"),
        "Digest of the entry": found.get("digest"),
    }
    return render(
        request,
        "league_entry.html",
        league=name,
        number=number,
        problem=found.get("problem", ""),
        ruling=found["ruling"],
        trials=trials,
        facts=list(facts.items()),
        model=model,
        job=evaluation.get("job", ""),
    )


@router.post("/leagues/{name}/entries/{number}/disqualify")
def disqualify(request: Request, name: str, number: int, form: Form = Depends(sent_form)) -> Response:
    """Say for good that an entry does not count."""
    body = body_of(cases.DisqualifyRequest, {"reason": form.one("reason").strip()})
    text = f"The entry stays as it is, and the table says for good that it does not count: {body.reason}"
    form.confirm(Question(f"Disqualify entry {number} of {name}?", text, "Disqualify"))
    cases.disqualify(controller_of(request), actor_of(request), name, number, body)
    return done(request, f"/leagues/{name}", f"entry {number} of {name} is disqualified")


def _racer(form: Form) -> dict[str, Any]:
    """Model, version and racer of a form. Raises ClientError."""
    name, sign, version = form.one("model").partition("@")
    if not name or (sign and not (version.isascii() and version.isdecimal() and len(version) < 10)):
        raise ClientError("model: choose one, such as fast@1")
    return {"model": name, "version": int(version) if sign else None, "racer": form.one("racer").strip() or None}


def _moment(key: str, text: str) -> float:
    """A time as Unix seconds, in UTC where it names no zone. Raises ClientError."""
    try:
        when = datetime.fromisoformat(text)
        return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        raise ClientError(f"{key}: expected a time such as 2026-12-24T18:00") from None


def _shown(league: Mapping[str, Any]) -> dict[str, Any]:
    """A league as a row of the list; without its facts where it was altered."""
    if "rules" not in league:
        return {"track": "", "laps": "", "ranking": "", "entries": "", "owner": "", "state": ""}
    closes = f"open until {moment(league['closes'])}" if league["closes"] else "open"
    state = str(league["closed"]).removeprefix(f"league {league['name']} ") if league["closed"] else closes
    rules = league["rules"]
    return {
        "track": ", ".join(league["track"]),
        "laps": rules["laps"],
        "ranking": rules["ranking"],
        "entries": league["entries"],
        "owner": league["owner"],
        "state": state,
    }


def _rules(league: Mapping[str, Any]) -> dict[str, Any]:
    """The rules of a league in words."""
    rules = league["rules"]
    counts = {"total": "the time of all laps", "best": "the best lap", "average": "the mean of the complete laps"}
    penalties = f"{rules['off_track_penalty']:g} s off the track, {rules['crash_penalty']:g} s for a crash"
    put_back = f"put back at most {counted(rules['max_resets'], 'time')} in a lap; {penalties}"
    return {
        "Tracks": ", ".join(league["track"]),
        "Laps": rules["laps"],
        "Ranked by": counts[rules["ranking"]],
        "Continuous": put_back if rules["continuous"] else "no: a car that leaves the road has ended its lap",
        "A lap": f"at most {rules['seconds']:g} s",
        "Seed": league["seed"],
        "Entries": f"{league['entries']}; at most {counted(league['most_entries'], 'entry', 'entries')} of each key or user",
        "Created": f"{moment(league['created'])} by {league['owner']}",
        "Digest": league["digest"],
    }


def _races(request: Request, name: str) -> Table:
    """The newest races of a league that the caller may see, by job, without those that are entered."""
    controller, actor = controller_of(request), actor_of(request)
    begins = f"race-{name}-".replace(".", "-")[:60]
    jobs = page_of_jobs(controller, actor, JobSelection(search=begins), _READ)["jobs"]
    if not jobs:
        return Table()
    described = batch.call(controller, actor, "DescribeJobs", {"jobs": [job["id"] for job in jobs]})["jobs"]
    tags = {each["jobId"]: each.get("tags") or {} for each in described}
    entered = cases.entered_jobs(controller_of(request), name)
    ours = [job for job in jobs if tags.get(job["id"], {}).get(LEAGUE_TAG) == name and job["id"] not in entered]
    return Table((job["id"], {**job, "model": str(tags[job["id"]].get(MODEL_TAG))}) for job in ours[:_RACES])
