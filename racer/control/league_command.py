"""The command ``muster league``: competitions for the fastest laps under one set of rules."""

from __future__ import annotations

import os
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import (
    CpusOption,
    FollowOption,
    JsonOption,
    ModelArgument,
    OverwriteOption,
    StoreOption,
    split_model,
)
from orchestrator.cli.controllers import controller, see_through
from orchestrator.cli.listings import Resource, show_facts
from orchestrator.cli.misuse import make_group
from orchestrator.cli.outputs import check_output
from orchestrator.cli.progress import await_end, follow_main
from orchestrator.cli.terminal import echo, echo_json
from orchestrator.client import Client, named
from orchestrator.domain.errors import ApiError, NotServing, UsageError
from racer.control.league_table import TABLE, write
from racer.store.leagues import moment
from racer.store.races import clock
from racer.store.standings import RANKINGS, differences
from shared_store.contract.error_text import counted, nearest

LeagueArgument = Annotated[str, typer.Argument(metavar="NAME", help="A league.")]
EntryArgument = Annotated[int, typer.Argument(metavar="ENTRY", min=1, help="The number of an entry.")]
OptionalEntry = Annotated[
    int | None, typer.Argument(metavar="[ENTRY]", min=1, help="The number of an entry.", show_default=False)
]

_EXAMPLES = """Examples:  muster league create cup --track oval --laps 3   then   muster league submit cup fast@1 --as ada
muster league table cup -o cup.png   and   muster league verify cup 1 --rerun"""


def register(app: typer.Typer) -> None:
    group = make_group(
        "Manage the racer's leagues: create, submit, table, verify and more. Leagues are append-only.",
        _EXAMPLES,
        _LEAGUES.lister("List the leagues with their rules."),
    )
    group.command(
        "create", epilog="Example:  muster league create cup --track oval --ranking best --closes 2026-12-24T18:00"
    )(create)
    _LEAGUES.add_list(group, "List the leagues with their rules.", "Example:  muster league list --json")
    group.command("show", epilog="Example:  muster league show cup     or, an entry:  muster league show cup 3")(show)
    group.command("submit", epilog="Example:  muster league submit cup fast@2 --as ada")(submit)
    group.command("table", epilog="Example:  muster league table cup -o cup.csv")(show_table)
    group.command("disqualify", epilog="Example:  muster league disqualify cup 3 --reason 'drove another car'")(
        disqualify
    )
    group.command("verify", epilog="Example:  muster league verify cup 3 --rerun")(verify)
    app.add_typer(group, name="league")


def create(
    name: Annotated[str, typer.Argument(help="Name of the league.")],
    track: Annotated[
        list[str],
        typer.Option(
            metavar="TRACK",
            help="A preset, random:SEED, or a track of the store. Repeatable: laps use the tracks in turn.",
        ),
    ],
    laps: Annotated[int, typer.Option(min=1, max=100, help="Number of laps in a race, each from the start line.")] = 3,
    ranking: Annotated[
        str,
        typer.Option(
            metavar="total|best|average",
            help="The ranking time: of all laps (total), of the best lap, or the average of the complete laps.",
        ),
    ] = "total",
    continuous: Annotated[
        bool,
        typer.Option("--continuous/--no-continuous", help="Put back a car that leaves the road and let it continue."),
    ] = False,
    off_track_penalty: Annotated[
        float, typer.Option(min=0, max=3600, help="Penalty in seconds for leaving the road, in a continuous race.")
    ] = 1.0,
    crash_penalty: Annotated[
        float, typer.Option(min=0, max=3600, help="Penalty in seconds for touching an obstacle, in a continuous race.")
    ] = 1.0,
    max_resets: Annotated[
        int,
        typer.Option(min=0, max=10_000, help="Number of times that a car is put back in a lap; the next time ends it."),
    ] = 100,
    seconds: Annotated[float, typer.Option(min=0.1, max=3600, help="Longest simulated time of a lap.")] = 1200.0,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of every race.")] = 1,
    opens: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="Opening time, such as 2026-12-01T18:00 (with Z: in UTC); now by default.",
            show_default=False,
        ),
    ] = None,
    closes: Annotated[
        str | None,
        typer.Option(
            metavar="TIME", help="Closing time, after which no race can start; never by default.", show_default=False
        ),
    ] = None,
    most_entries: Annotated[
        int, typer.Option(min=1, max=10_000, help="Greatest number of entries of each key or user.")
    ] = 99,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Create a league. Its rules can't be changed."""
    if ranking not in RANKINGS:
        raise UsageError(f"--ranking {ranking}: there is no such ranking; {nearest(ranking, RANKINGS)}")
    body = {
        "name": name,
        "track": track,
        "laps": laps,
        "ranking": ranking,
        "continuous": continuous,
        "off_track_penalty": off_track_penalty,
        "crash_penalty": crash_penalty,
        "max_resets": max_resets,
        "seconds": seconds,
        "seed": seed,
        "opens": _moment("--opens", opens),
        "closes": _moment("--closes", closes),
        "most_entries": most_entries,
    }
    with controller(store, None) as connect:
        found = connect().post("/api/leagues", body)
    if as_json:
        echo_json(found, indent=1)
    else:
        _print_league(found)


def _moment(option: str, text: str | None) -> float | None:
    """A time as Unix seconds, in this machine's time zone unless it names one. Raises UsageError."""
    if text is None:
        return None
    try:
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError):
        raise UsageError(f"{option} {text}: expected a time such as 2026-12-24T18:00, or 2026-12-24T18:00Z") from None


def _state(league: Mapping[str, Any]) -> str:
    if league["closed"]:
        return str(league["closed"]).removeprefix(f"league {league['name']} ")
    return f"open until {moment(league['closes'])}" if league["closes"] else "open"


_LEAGUES = Resource(
    {
        "LEAGUE": "name",
        "TRACK": lambda league: ", ".join(league["track"]),
        "LAPS": lambda league: league["rules"]["laps"],
        "RANKING": lambda league: league["rules"]["ranking"],
        "ENTRIES": "entries",
        "OWNER": "owner",
        "STATE": _state,
    },
    "no league was created yet; muster league create NAME --track oval",
    "/api/leagues",
    problem=("problem", ""),
)
_LAPS = Resource(
    {
        "LAP": "trial",
        "TIME": lambda lap: clock(lap.get("time")),
        "PENALTY": lambda lap: f"{lap.get('penalty') or 0:g} s",
        "COMPLETE": lambda lap: f"{lap.get('completion') or 0:.1f} %",
        "OFF-TRACKS": "off_tracks",
        "CRASHES": "crashes",
        "RESETS": "resets",
        "STATUS": "status",
    }
)


def show(
    league: LeagueArgument, entry: OptionalEntry = None, store: StoreOption = None, as_json: JsonOption = False
) -> None:
    """Show the rules of a league; of an entry its model, its evaluation and its laps; exit 1 where it or its model is altered."""
    path = f"/api/leagues/{named(league)}" + ("" if entry is None else f"/entries/{entry}")
    with controller(store, None) as connect:
        found = connect().get(path, seconds=300)
    if as_json:
        echo_json(found, indent=1)
    elif entry is None:
        _print_league(found)
    else:
        _print_entry(found)
    if found.get("problem"):
        raise typer.Exit(1)


def _print_league(league: Mapping[str, Any]) -> None:
    rules = league["rules"]
    counts = {"total": "the time of all laps", "best": "the best lap", "average": "the mean of the complete laps"}
    echo(f"{league['name']}: {counted(rules['laps'], 'lap')} on {', '.join(league['track'])}; {_state(league)}")
    continuous = "no, a car that leaves the road has ended its lap"
    if rules["continuous"]:
        penalties = f"{rules['off_track_penalty']:g} s off the track, {rules['crash_penalty']:g} s for a crash"
        continuous = f"put back at most {counted(rules['max_resets'], 'time')} in a lap; {penalties}"
    most = counted(league["most_entries"], "entry", "entries")
    facts = {
        "ranked by": counts[rules["ranking"]],
        "continuous": continuous,
        "lap": f"at most {rules['seconds']:g} s, seed {league['seed']}",
        "entries": f"{league['entries']}; at most {most} of each key or user",
        "created": f"{moment(league['created'])} by {league['owner']}",
        "digest": league["digest"],
    }
    show_facts(facts, 11)


def _print_entry(entry: Mapping[str, Any]) -> None:
    if "race" in entry:
        model, evaluation = entry["model"], entry["evaluation"]
        echo(f"entry {entry['entry']}: {entry['racer']} with {model['name']}@{model['version']} ({model['task']})")
        _LAPS.show(entry["race"]["trials"])
        facts = {
            "entered": f"{moment(entry['entered'])} by {entry['owner']}",
            "evaluation": f"{evaluation['name']} of run {evaluation['run']}, job {evaluation['job']}",
            "model": model["digest"],
            "digest": entry["digest"],
        }
        show_facts(facts, 12)
    if ruling := entry.get("ruling"):
        echo(f"  disqualified: {ruling['reason']}")
    if entry.get("problem"):
        echo(f"  problem:     {entry['problem']}" if "race" in entry else f"entry {entry['entry']}: {entry['problem']}")


def submit(
    league: LeagueArgument,
    model: ModelArgument,
    racer: Annotated[
        str | None,
        typer.Option("--as", metavar="RACER", help="Name of the racer; by default the name of the key or the user."),
    ] = None,
    evaluation: Annotated[
        str | None,
        typer.Option(metavar="JOB", help="Enter this finished race instead of a new one.", show_default=False),
    ] = None,
    store: StoreOption = None,
    cpus: CpusOption = None,
    follow: FollowOption = True,
    as_json: JsonOption = False,
) -> None:
    """Race a model under the rules of a league, follow the race to its end, and enter it permanently.

    The race is an evaluation job, with a temporary controller if none is running. With --no-follow, enter it with --evaluation after
    it has ended. An altered model, a league that is not open and too
    many entries are refused before it starts.
    """
    name, version = split_model(model)
    if not follow and evaluation:
        raise UsageError("--no-follow starts a race and --evaluation enters one that has ended; leave one of them out")
    body = {"model": name, "version": version, "racer": racer, "directory": os.getcwd()}
    path = f"/api/leagues/{named(league)}"
    if not follow:
        with Client.connect() as client:
            _print_started(client.post(f"{path}/races", body, seconds=300, once=True), league, racer, as_json)
        return
    with controller(store, cpus) as connect:
        client = connect()
        if evaluation is None:
            started = client.post(f"{path}/races", body, seconds=300, once=True)
            code = see_through(client, started["jobId"], await_end if as_json else follow_main)
            if code:
                raise typer.Exit(code)
            body["version"], evaluation = (
                started["version"],
                started["jobId"],
            )  # the newest model may have changed since
        entry = client.post(f"{path}/entries", {**body, "job": evaluation}, seconds=300)
        rows = client.get(f"{path}/entries", every=True)
    row = next(each for each in rows if each["entry"] == entry["entry"])
    if as_json:
        echo_json(row, indent=1)
        return
    place = f"rank {row['rank']}" if row["rank"] else f"{row['status']} ({row['reason']})"
    echo(f"entry {row['entry']} of {league}: {row['racer']} with {row['model']}, {clock(row['time'])}, {place}")


def _print_started(started: Mapping[str, Any], league: str, racer: str | None, as_json: bool) -> None:
    if as_json:
        echo_json(started)
        return
    reference, job = f"{started['model']}@{started['version']}", started["jobId"][:8]
    echo(f"submitted the race of {reference} as {started['jobId']}")
    name = f" --as '{racer}'" if racer else ""
    echo(f"enter it after it has ended: muster league submit {league} {reference}{name} --evaluation {job}")


def show_table(
    league: LeagueArgument,
    every: Annotated[bool, typer.Option("--all", help="Show every entry of a racer, not only the best.")] = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Write the table as .csv, or as a picture (.png).", show_default=False),
    ] = None,
    overwrite: OverwriteOption = False,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the ranking: each racer's best entry, then unranked entries with the reason."""
    if output is not None:
        check_output(output, overwrite, ".csv", ".png")
    with controller(store, None) as connect:
        client = connect()
        found = client.get(f"/api/leagues/{named(league)}")
        rows = client.get(f"/api/leagues/{named(league)}/entries", every=every)
    if output is not None:
        write(found, rows, output)
    if as_json:
        echo_json(rows, indent=1)
        return
    if not rows:
        echo(f"{league} has no entries yet; muster league submit {league} MODEL")
    else:
        TABLE.show(rows)
    if output is not None:
        echo(f"written: {output}")


def disqualify(
    league: LeagueArgument,
    entry: EntryArgument,
    reason: Annotated[str, typer.Option(help="Shown in the table, permanently.")],
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Mark an entry as disqualified, with a reason. The entry itself stays unchanged. Only the league's owner may do this."""
    with controller(store, None) as connect:
        found = connect().post(f"/api/leagues/{named(league)}/entries/{entry}/disqualify", {"reason": reason})
    if as_json:
        echo_json(found, indent=1)
    else:
        echo(f"entry {entry} of {league} is disqualified: {reason}")


def verify(
    league: LeagueArgument,
    entry: OptionalEntry = None,
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Race each entry again with the same seed, and compare every lap.")
    ] = False,
    store: StoreOption = None,
    cpus: CpusOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check that entries and their models are unchanged; exit 1 if anything differs."""
    path = f"/api/leagues/{named(league)}"
    answer = []
    with controller(store, cpus) as connect:
        client = connect()
        last = client.get(path)["entries"]
        for number in range(1, last + 1) if entry is None else (entry,):
            found = client.get(f"{path}/entries/{number}", seconds=300)
            problems = [found["problem"]] if found.get("problem") else []
            if rerun and not problems:
                problems = _again(client, f"{path}/entries/{number}/races", found)
            answer.append({"entry": number, "problems": problems})
            good = "every lap is the same, bit for bit" if rerun else "the entry and its model are unchanged"
            for line in [] if as_json else problems or [good]:
                echo(f"entry {number}: {line}")
    if as_json:
        echo_json(answer, indent=1)
    elif not answer:
        echo(f"{league} is unchanged and has no entries")
    if any(each["problems"] for each in answer):
        raise typer.Exit(1)


def _again(client: Client, path: str, entry: Mapping[str, Any]) -> list[str]:
    """Differences between an entry and a repetition of its race, one line each."""
    try:
        started = client.post(path, {"directory": os.getcwd()}, seconds=300, once=True)
    except NotServing:
        raise
    except ApiError as error:  # of this entry only: for example, its checkpoint was deleted
        return [str(error)]
    if see_through(client, started["jobId"], await_end):
        return [f"its race was not driven again: job {started['jobId'][:8]} did not succeed"]
    listed = client.get(f"/api/runs/{named(started['run'])}/evaluations")
    again = next(each for each in listed if each.get("job") == started["jobId"])
    lines = differences(entry["race"], again["race"])
    before, now = (each.get("versions") or {} for each in (entry, again))
    if lines:
        lines += [f"{name} {before.get(name)} became {now[name]}" for name in now if before.get(name) != now[name]]
    return lines
