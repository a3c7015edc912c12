"""The table of a league: its columns, as CSV, and as a picture drawn without a display."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from orchestrator.cli.listings import Resource
from orchestrator.domain.errors import UsageError
from racer.store.races import clock
from racer.store.standings import Row
from shared_store.volume.files import EVERY_LEVEL, write_atomic


def _status(row: Mapping[str, Any]) -> str:
    words = {"ranked": "ranked", "altered": row["reason"]}
    return words.get(row["status"]) or f"{row['status']}: {row['reason']}"


TABLE = Resource(
    {
        "RANK": lambda row: row["rank"] or None,
        "ENTRY": "entry",
        "RACER": "racer",
        "MODEL": "model",
        "TIME": lambda row: clock(row["time"]),
        "BEST LAP": lambda row: clock(row["best_lap"]),
        "LAPS": lambda row: None if row["laps"] is None else f"{row['completed']} of {row['laps']}",
        "OFF-TRACKS": "off_tracks",
        "CRASHES": "crashes",
        "RESETS": "resets",
        "STATUS": _status,
    }
)


def write(league: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write the table to ``path``, a .csv (times in seconds) or a .png. Raises UsageError if it can't."""
    try:
        content = _csv(rows) if path.suffix == ".csv" else _picture(league, rows)
        write_atomic(path.absolute(), content, levels=EVERY_LEVEL)
    except ImportError:
        raise UsageError(
            f"-o {path}: a picture needs matplotlib, which this environment lacks: pip install 'muster[plot]'; .csv needs nothing"
        ) from None
    except OSError as error:
        raise UsageError(f"-o {path}: {error.strerror or error}") from None


def _csv(rows: Sequence[Mapping[str, Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(Row.__dataclass_fields__), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def _picture(league: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = [[*TABLE.texts(row)[:-1], row["status"]] for row in rows]
    figure = Figure(figsize=(11, 1.2 + 0.3 * len(shown)), dpi=120)
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.set_axis_off()
    rules = league["rules"]
    title = f"{league['name']}: {rules['laps']} x {', '.join(league['track'])}, ranked by {rules['ranking']}"
    axes.set_title(title.replace("$", r"\$"), loc="left")
    texts = [[each.replace("$", r"\$") for each in row] for row in (shown or [["-"] * len(TABLE.columns)])]
    table = axes.table(
        cellText=texts, colLabels=list(TABLE.columns), cellLoc="left", loc="upper left", edges="horizontal"
    )
    table.auto_set_font_size(False)
    table.set_fontsize(9)
    table.auto_set_column_width(range(len(TABLE.columns)))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", bbox_inches="tight")
    return buffer.getvalue()
