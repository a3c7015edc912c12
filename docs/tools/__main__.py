"""``python -m docs.tools`` writes the pages that are made from the code."""

from __future__ import annotations

import re
from pathlib import Path

import warp as wp

from docs.tools import reward_table, settings_page, terms_pages

DOCS = Path(__file__).parents[1]
PAGES = {
    "tasks/terms.md": terms_pages.reference,
    "tasks/porting.md": terms_pages.porting,
    "tasks/settings.md": settings_page.page,
}
TABLES = {"racer/rewards.md": reward_table.table}
"""Pages in which one table is replaced: the one with the same first line."""


def main() -> None:
    """Write all pages, in place."""
    for name, page in PAGES.items():
        (DOCS / name).write_text(page())
    for name, table in TABLES.items():
        path, rows = DOCS / name, table()
        before, head, after = path.read_text().partition(rows.partition("\n")[0])
        path.write_text(before + rows + re.sub(r"^\n(\|.*\n)*", "", after) if head else before)


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_WARNING
    main()
