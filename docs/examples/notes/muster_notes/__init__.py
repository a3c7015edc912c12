"""Notes on runs: a plug-in of Muster. This module is read by every command, so it imports nothing else."""

from shared_store.contract.plugins import Command, Plugin

PLUGIN = Plugin(
    operations=("GET /api/notes", "POST /api/notes/{run}", "GET /notes"),
    routers=("muster_notes.routes:router",),
    pages=("muster_notes.routes:pages",),
    navigation=(("Notes", "/notes"),),
    templates="muster_notes",
    commands=(Command("notes", "muster_notes.command", "Runs", "Print the notes on all runs or on one, or add one."),),
    folders=("notes",),
    references="muster_notes.store:references",
    bundle_parts="muster_notes.task:bundle_parts",
)
