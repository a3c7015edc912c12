"""The table of all keys of ``params``, which the racer's page of reward functions has."""

from __future__ import annotations

from racer.rewards.parameters import PARAMETERS


def table() -> str:
    """The keys as a table in Markdown, as the page has it."""
    lines = ["| key | type | unit | values | what it is |", "|---|---|---|---|---|"]
    for each in PARAMETERS:
        least, most = ("" if bound is None else f"{bound:g}" for bound in each.limits)
        values = (
            f"{least} to {most}" if least and most else f"from {least}" if least else f"up to {most}" if most else ""
        )
        note = "" if each.documented else " (not documented by AWS)"
        lines.append(f"| `{each.name}` | `{each.type}` | {each.unit} | {values} | {each.meaning}{note} |")
    return "\n".join(lines) + "\n"
