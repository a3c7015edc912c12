"""Operations of the racer's routes, each by its method and path."""

from __future__ import annotations

from orchestrator.services.permissions import AddedOperation

CREATE_LEAGUE = AddedOperation("POST /api/leagues")
RACE = AddedOperation("POST /api/leagues/{name}/races")
RERUN_ENTRY = AddedOperation("POST /api/leagues/{name}/entries/{number}/races")
ENTER_LEAGUE = AddedOperation("POST /api/leagues/{name}/entries")
DISQUALIFY = AddedOperation("POST /api/leagues/{name}/entries/{number}/disqualify")
LIST_TRACKS = AddedOperation("GET /api/tracks")
MAKE_TRACK = AddedOperation("POST /api/tracks")
