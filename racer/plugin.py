"""The plug-in that adds the racer to Muster."""

from __future__ import annotations

from shared_store.contract.plugins import Command, JobSection, Plugin

PLUGIN = Plugin(
    operations=(
        "GET /api/leagues",
        "POST /api/leagues",
        "GET /api/leagues/{name}",
        "GET /api/leagues/{name}/entries",
        "GET /api/leagues/{name}/entries/{number}",
        "POST /api/leagues/{name}/races",
        "POST /api/leagues/{name}/entries/{number}/races",
        "POST /api/leagues/{name}/entries",
        "POST /api/leagues/{name}/entries/{number}/disqualify",
        "GET /api/tracks",
        "POST /api/tracks",
        "GET /leagues",
        "POST /leagues",
        "GET /leagues/{name}",
        "GET /leagues/{name}/stream",
        "POST /leagues/{name}/races",
        "POST /leagues/{name}/entries",
        "GET /leagues/{name}/entries/{number}",
        "POST /leagues/{name}/entries/{number}/disqualify",
        "GET /tracks",
        "POST /tracks",
        "GET /tracks/{name}",
        "GET /tracks/{name}/outline.svg",
        "GET /tracks/{name}/picture.png",
    ),
    routers=("racer.control.leagues:router", "racer.control.track_routes:router"),
    pages=("racer.control.track_pages:router", "racer.control.league_pages:router"),
    navigation=(("League", "/leagues"), ("Tracks", "/tracks")),
    templates="racer.control",
    forms=("racer.control.submit_form:FORM",),
    commands=(
        Command(
            "tracks",
            "racer.control.track_command",
            "Controller",
            "Manage the racer's tracks: list, show, make, import. Tracks are immutable.",
        ),
        Command(
            "league",
            "racer.control.league_command",
            "Controller",
            "Manage the racer's leagues: create, submit, table, verify and more. Leagues are append-only.",
        ),
    ),
    options=(("evaluate", "racer.control.evaluate_options:OPTIONS"),),
    sections=(
        JobSection(
            key="race",
            verb="races",
            model="racer.control.race_section:Race",
            rank="racer.race",
            rules="racer.race.rules:RULES",
            watcher="racer.race.trials:Laps",
        ),
    ),
    folders=("tracks", "leagues"),
    run_folders=("sim-trace",),
    references="racer.store.references:references",
)
"""Everything that the racer adds beside its tasks."""
