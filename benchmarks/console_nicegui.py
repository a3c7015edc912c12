"""The table of jobs in NiceGUI 3, for ``python -m benchmarks.console_stack``: ``console_nicegui.py PORT JOBS.json ROWS [CSP]``.

The jobs come from a file that the console's own API wrote. ROWS: how many the browser gets at once. Each second one job changes. CSP: the
``Content-Security-Policy`` of every answer.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from nicegui import app, ui

PORT, SOURCE, ROWS, *SUPPLIED = sys.argv[1:]
JOBS: list[dict[str, Any]] = json.loads(Path(SOURCE).read_text())
FIELDS = ("name", "status", "reason", "queue", "nodes", "progress", "rate", "reward", "created", "ran", "owner")
changed = {"count": 0}


async def policy(request: Any, call_next: Any) -> Any:
    answer = await call_next(request)
    if SUPPLIED:
        answer.headers["Content-Security-Policy"] = SUPPLIED[0]
    return answer


def change() -> None:
    changed["count"] += 1
    JOBS[changed["count"] % 50]["status"] = "FAILED" if changed["count"] // 50 % 2 == 0 else "RUNNABLE"


def jobs() -> None:
    ui.label("Jobs").classes("text-h4")
    columns = [{"name": name, "label": name.capitalize(), "field": name, "align": "left"} for name in FIELDS]
    table = ui.table(columns=columns, rows=JOBS[: int(ROWS)], row_key="id", selection="multiple", pagination=50)
    seen = {"count": changed["count"]}

    def look() -> None:
        if seen["count"] != changed["count"]:
            seen["count"] = changed["count"]
            table.rows = [dict(each) for each in JOBS[: int(ROWS)]]

    ui.timer(0.5, look)


app.middleware("http")(policy)
ui.page("/")(jobs)
app.timer(1.0, change)
ui.run(host="127.0.0.1", port=int(PORT), show=False, reload=False, title="Jobs")
