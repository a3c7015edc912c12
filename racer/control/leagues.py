"""Leagues: create one, race a model in it, enter the race, read the table; each use case is a route of the native API, too."""

from __future__ import annotations

import contextlib
import os
import re
import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query
from pydantic import BaseModel, ConfigDict, Field

from orchestrator.api.http.callers import user_name
from orchestrator.api.http.requests import IDEMPOTENCY_HEADER, actor_of, controller_of
from orchestrator.api.http.store_route import StoreRoute
from orchestrator.control.controller import Controller
from orchestrator.domain.errors import ClientError
from orchestrator.domain.job import Status
from orchestrator.domain.reasons import named
from orchestrator.persistence.queries import find_job, unknown_job
from orchestrator.services import submission
from orchestrator.services.chosen_checkpoints import CONFLICT
from orchestrator.services.context import using
from orchestrator.services.models import any_model, find_model, owner_of_model
from orchestrator.services.permissions import CONTROLLER, Actor, Owned
from orchestrator.services.spec_submission import submit_spec
from orchestrator.spec.settings import task_config
from racer.control import operations
from racer.control.league_races import race_job
from racer.settings.task import RacerConfig
from racer.store import leagues as stored_leagues
from racer.store.leagues import League, LeagueError, Rules, StoredLeague, UnknownLeague
from racer.store.standings import BadRace, Ranking, read_race, table
from shared_store.contract.error_text import shown
from shared_store.volume import bundles
from shared_store.volume.bundles import DamagedBundle
from shared_store.volume.checkpoints import Checkpoint, DamagedCheckpoint, checkpoint_called
from shared_store.volume.evaluations import list_evaluations
from shared_store.volume.files import DamagedFile
from shared_store.volume.models import Model

LEAGUE_TAG, MODEL_TAG = "muster:league", "muster:model"
"""Tags of a race's job: the league, and the model as ``NAME@VERSION``."""
_RACER = re.compile(r"\w[\w .'-]{0,63}")
router = APIRouter(route_class=StoreRoute)
_Controller = Annotated[Controller, Depends(controller_of)]
_Actor = Annotated[Actor, Depends(actor_of)]
_Key = Annotated[str | None, Header(alias=IDEMPOTENCY_HEADER)]
_Seconds = Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)]
_Moment = Annotated[float, Field(ge=0, lt=1e11, allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class CreateRequest(_Strict):
    """The rules of a new league."""

    name: str = Field(max_length=128)
    track: list[str] = Field(min_length=1, max_length=64, description="a preset, random:SEED, or a track of the store")
    laps: int = Field(default=3, ge=1, le=100)
    ranking: Ranking = "total"
    continuous: bool = Field(default=False, description="a car that leaves the road is put back and continues")
    off_track_penalty: _Seconds = 1.0
    crash_penalty: _Seconds = 1.0
    max_resets: int = Field(default=100, ge=0, le=10_000, description="in one lap")
    seconds: float = Field(default=1200.0, gt=0, le=3600, description="simulated, that a lap may take")
    seed: int = Field(default=1, ge=0, lt=2**31)
    opens: _Moment | None = Field(default=None, description="Unix time in seconds; at once where absent")
    closes: _Moment | None = Field(default=None, description="Unix time in seconds; never where absent")
    most_entries: int = Field(default=99, ge=1, le=10_000, description="of each key or user")


class RaceRequest(_Strict):
    """Which model races."""

    model: str = Field(max_length=128)
    version: int | None = Field(default=None, ge=1, description="the newest where absent")
    racer: str | None = Field(
        default=None, max_length=200, description="who races; the name of the key or user where absent"
    )
    directory: str = Field(default="", description="working directory of the job")


class EnterRequest(RaceRequest):
    """Which race becomes an entry."""

    job: str = Field(max_length=200, description="the evaluation's job, which has ended")


class RerunRequest(_Strict):
    """The request for another race of an entry."""

    directory: str = Field(default="", description="working directory of the job")


class DisqualifyRequest(_Strict):
    """Why an entry does not count."""

    reason: str = Field(min_length=1, max_length=500)


@router.get("/leagues")
def list_leagues(controller: _Controller) -> list[dict[str, Any]]:
    """All leagues by name, with their rules; an altered one has a ``problem``."""
    store = controller.access.store
    with _refusals():
        return [_described(stored_leagues.find(store, name)) for name in stored_leagues.names(store)]


@router.post("/leagues")
def create_league(controller: _Controller, actor: _Actor, body: CreateRequest) -> dict[str, Any]:
    """Create a league; its rules are never changed."""
    actor.check(operations.CREATE_LEAGUE)
    controller.writes.check(adds=True)
    if body.opens is not None and body.closes is not None and body.opens >= body.closes:
        raise ClientError("opens: the league would close before it opens")
    if body.closes is not None and body.closes <= time.time():
        raise ClientError(
            f"closes: {stored_leagues.moment(body.closes)} is past: no race could ever start; name a later time, or none"
        )
    fields = body.model_dump()
    rules = Rules(**{key: fields[key] for key in asdict(Rules())})
    with _refusals(f"league {body.name}", 400):
        digests = {name: stored_leagues.digest_of_track(controller.access.store, name) for name in body.track}
        league = League(
            name=body.name,
            track=tuple(body.track),
            rules=rules,
            seed=body.seed,
            owner=_caller(actor),
            created=time.time(),
            opens=body.opens,
            closes=body.closes,
            most_entries=body.most_entries,
            track_digests={name: digest for name, digest in digests.items() if digest is not None},
        )
        return _described(stored_leagues.create(controller.access.store, league))


@router.get("/leagues/{name}")
def read_league(controller: _Controller, name: str) -> dict[str, Any]:
    """The rules of a league, and how many entries it has."""
    return _described(_find(controller, name)[0])


@router.get("/leagues/{name}/entries")
def league_table(
    controller: _Controller, name: str, every: Annotated[bool, Query(description="all entries of each racer")] = False
) -> list[dict[str, Any]]:
    """The table, the first one ahead: of each racer the best entry, or ``every`` one, then those that are not ranked and why."""
    stored, league = _find(controller, name)
    with _refusals():
        return [row.document() for row in table(stored.contenders(), league.rules.ranking, every=every)]


@router.get("/leagues/{name}/entries/{number}")
def read_entry(controller: _Controller, actor: _Actor, name: str, number: int) -> Any:
    """An entry with its race and, where it is disqualified, the ruling; ``problem`` tells what was altered in it or in its model."""
    stored, _ = _find(controller, name)
    found: dict[str, Any] = {"entry": number}
    try:
        found = stored.entry(number)
        model = any_model(controller, found["model"]["name"], found["model"]["version"])
        _verify(model)
        _check_digest(model, found)
    except UnknownLeague as error:
        raise ClientError(str(error), 404) from None
    except LeagueError as error:
        found["problem"] = stored.problem(number, error)
    except ClientError as error:  # of its model
        found["problem"] = str(error)
    return actor.shown({**found, "ruling": stored.ruling(number)})


@router.post("/leagues/{name}/races")
def race(
    controller: _Controller,
    actor: _Actor,
    name: str,
    body: RaceRequest,
    idempotency_key: _Key = None,
) -> dict[str, Any]:
    """Submit the evaluation of a model by the league's rules; a second call with the same idempotency key gets the answer of the first one."""
    stored, league = _find(controller, name)
    model = find_model(controller, actor, body.model, body.version)
    actor.check(operations.RACE, owner_of_model(model))
    with _refusals():
        if closed := league.closed(time.time()):
            raise LeagueError(closed)
        stored.admit(_caller(actor), _racer(actor, body))
    return _submit(controller, actor, league, model, body.directory, idempotency_key)


@router.post("/leagues/{name}/entries/{number}/races")
def rerun(
    controller: _Controller,
    actor: _Actor,
    name: str,
    number: int,
    body: RerunRequest,
    idempotency_key: _Key = None,
) -> dict[str, Any]:
    """Submit the race of an entry once more, whether the league is open or not; on a CPU its laps are the same."""
    stored, league = _find(controller, name)
    with _refusals():
        entry = stored.entry(number)
    model = any_model(controller, entry["model"]["name"], entry["model"]["version"])
    actor.check(operations.RERUN_ENTRY, owner_of_model(model))
    _check_digest(model, entry)
    return _submit(controller, actor, league, model, body.directory, idempotency_key)


@router.post("/leagues/{name}/entries")
def enter(controller: _Controller, actor: _Actor, name: str, body: EnterRequest) -> dict[str, Any]:
    """Make an entry of a race that has ended: the model's digest, the evaluation and its laps, for good."""
    stored, league = _find(controller, name)
    model = find_model(controller, actor, body.model, body.version)
    actor.check(operations.ENTER_LEAGUE, owner_of_model(model))
    controller.writes.check(adds=True)
    checkpoint = _checked(controller, league, model)
    job, run = _race_of(controller, actor, league, body.job)
    cited = model.facts()["run"]
    with using(controller, cited, run):
        summary = _summary(controller, league, model, checkpoint, job)
        entry = {
            "racer": _racer(actor, body),
            "owner": _caller(actor),
            "model": {**_identity(model), "task": summary.get("task")},
            "evaluation": {"run": cited, "name": summary["name"], "job": job, "time": summary["time"]},
            "versions": summary.get("versions"),
            "race": summary["race"],
        }
        with _refusals(f"league {name}: the entry"):
            return stored.enter(entry)


@router.post("/leagues/{name}/entries/{number}/disqualify")
def disqualify(
    controller: _Controller, actor: _Actor, name: str, number: int, body: DisqualifyRequest
) -> dict[str, Any]:
    """Disqualify an entry for good, with the reason; the entry itself stays as it is. For the league's owner."""
    stored, league = _find(controller, name)
    actor.check(operations.DISQUALIFY, Owned("league", league.name, league.owner))
    controller.writes.check(adds=True)
    with _refusals(f"league {name}: the ruling"):
        stored.disqualify(number, body.reason, _caller(actor))
    return {"entry": number, "ruling": stored.ruling(number)}


def entered_jobs(controller: Controller, name: str) -> set[str]:
    """The jobs whose races are entries of a league, without those of altered entries."""
    stored, _ = _find(controller, name)
    found = set()
    for number in stored.numbers():
        with contextlib.suppress(LeagueError):
            found.add(str(stored.entry(number)["evaluation"]["job"]))
    return found


def _find(controller: Controller, name: str) -> tuple[StoredLeague, League]:
    """Raises ClientError where the league does not exist, or its rules were altered."""
    with _refusals():
        stored = stored_leagues.find(controller.access.store, name)
        return stored, stored.definition()


@contextlib.contextmanager
def _refusals(writing: str = "", status: int = CONFLICT) -> Iterator[None]:
    """Raise ClientError for an error of a league, and where the file ``writing`` stands for can't be written."""
    try:
        yield
    except LeagueError as error:
        raise ClientError(str(error), 404 if isinstance(error, UnknownLeague) else status) from None
    except OSError as error:
        raise ClientError(f"{writing} can't be written ({error.strerror or error})", 503) from None


def _described(stored: StoredLeague) -> dict[str, Any]:
    try:
        league = stored.definition()
        found: dict[str, Any] = {**asdict(league), "digest": stored.digest(), "entries": len(stored.numbers())}
        return {**found, "closed": league.closed(time.time())}
    except LeagueError as error:
        return {"name": stored.name, "problem": str(error)}


def _caller(actor: Actor) -> str:
    """The owner of the caller's leagues and entries. A command that runs its controller acts for this user, like one on loopback."""
    return f"user {user_name(os.getuid())}" if actor == CONTROLLER else actor.name


def _racer(actor: Actor, body: RaceRequest) -> str:
    """Name of the racer: the caller's, unless the request gives another. Raises ClientError."""
    if body.racer is None:
        return _caller(actor).removeprefix("key ").removeprefix("user ")
    if not _RACER.fullmatch(body.racer):
        raise ClientError(
            f"racer {shown(body.racer)}: use letters, digits, spaces, dots, hyphens, apostrophes and '_', at most 64, the first a "
            "letter or digit"
        )
    return body.racer


def _submit(
    controller: Controller, actor: Actor, league: League, model: Model, directory: str, idempotency_key: str | None
) -> dict[str, Any]:
    """Submit the race of a model. Raises ClientError."""
    _checked(controller, league, model)
    facts = model.facts()
    queue = str(facts.get("queue") or (facts.get("spec") or {}).get("queue") or "default")
    spec = race_job(league, model.reference, facts, queue)
    job, _ = submit_spec(
        controller,
        actor,
        spec,
        directory,
        f"league {league.name}, race of {model.reference}",
        tags={LEAGUE_TAG: league.name, MODEL_TAG: model.reference},
        idempotency_key=idempotency_key,
    )
    return {**submission.answer(job), "model": model.name, "version": model.version, "run": facts["run"]}


def _checked(controller: Controller, league: League, model: Model) -> Checkpoint:
    """The checkpoint that a sound model was made of, which a race loads. Raises ClientError."""
    _verify(model)
    facts = model.facts()
    with _refusals():
        league.check_tracks(controller.access.store)
    kind = task_config(str(facts.get("task")))
    if kind is None or not issubclass(kind, RacerConfig):  # what a class of the user's own drives is unknown
        raise ClientError(
            f"model {model.reference} is of task {facts.get('task')}; a league takes models of the racer's installed tasks"
        )
    name, run = str(facts.get("checkpoint")), controller.access.store.run(str(facts.get("run")))
    found = checkpoint_called(run.checkpoints, name)
    gone = ClientError(
        f"model {model.reference}: checkpoint {name} of run {run.name}, which a race loads, is gone; register one that is there",
        CONFLICT,
    )
    if found is None or not found.path.is_dir():
        raise gone
    try:
        found.verify()
    except DamagedCheckpoint as error:
        raise ClientError(f"model {model.reference}: run {run.name}: {error}", CONFLICT) from None
    if found.manifest["files"] != facts.get("checkpoint_files"):
        raise gone  # another run has the name of the one that was trained
    return found


def _identity(model: Model) -> dict[str, Any]:
    return {"name": model.name, "version": model.version, "digest": _digest(model)}


def _race_of(controller: Controller, actor: Actor, league: League, reference: str) -> tuple[str, str]:
    """Id and run of a job that has succeeded, and was submitted while the league was open. Raises ClientError."""
    with controller.database.session() as session:
        job = find_job(session, reference, actor.queues, actor.name)
        if job is None:
            raise ClientError(unknown_job(session, reference, actor.queues, actor.name), 404)
        actor.check(operations.ENTER_LEAGUE, job)
        if job.status != Status.SUCCEEDED:
            raise ClientError(
                f"job {named(job.name, job.id)} is {job.status}: only a race that has SUCCEEDED is entered", CONFLICT
            )
        if closed := league.closed(job.created_at / 1000):
            raise ClientError(f"{closed}, and job {named(job.name, job.id)} was not submitted in between", CONFLICT)
        return job.id, job.run


def _summary(controller: Controller, league: League, model: Model, checkpoint: Checkpoint, job: str) -> dict[str, Any]:
    """The evaluation that a job made of the model's checkpoint, which is a race of this league. Raises ClientError."""
    run = controller.access.store.run(model.facts()["run"])
    found = next((each for each in list_evaluations(run) if each.get("job") == job), None)
    if found is None:
        raise ClientError(
            f"job {job[:8]} has left no evaluation of run {run.name}, of which {model.reference} is", CONFLICT
        )
    what = f"league {league.name}: evaluation {found['name']} can't be entered"
    if found["checkpoint"] != checkpoint.name:
        raise ClientError(
            f"{what}: it is of checkpoint {found['checkpoint']}, the model of {checkpoint.name}", CONFLICT
        )
    if problem := league.misfit(found):
        raise ClientError(f"{what}: {problem}", CONFLICT)
    try:
        read_race(found["race"])
    except BadRace as error:
        raise ClientError(f"{what}: {error}", CONFLICT) from None
    return found


def _verify(model: Model) -> None:
    """Raise ClientError where the model has changed since its registration."""
    try:
        model.verify()
    except DamagedBundle as error:
        raise ClientError(f"model {model.reference}: {bundles.reason(error, model.path)}", CONFLICT) from None


def _digest(model: Model) -> str:
    """SHA-256 of the manifest of a model, which has the digests of all its files. Raises ClientError."""
    try:
        return str(bundles.read_manifest(model.path)["digest"])
    except (DamagedBundle, DamagedFile) as error:
        raise ClientError(f"model {model.reference}: {bundles.reason(error, model.path)}", CONFLICT) from None


def _check_digest(model: Model, entry: dict[str, Any]) -> None:
    """Raise ClientError where the model is not the one that was entered."""
    if _digest(model) != entry["model"].get("digest"):
        raise ClientError(f"model {model.reference} is another one than the one that was entered", CONFLICT)
