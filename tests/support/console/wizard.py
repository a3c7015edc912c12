"""The wizard of a new job, as a person fills it in."""

from __future__ import annotations

from typing import Any

from tests.support.console.visitor import Page, Visitor

HOSTILE = "</textarea></pre><script>alert(1)</script>"


def inputs(page: Page) -> dict[str, Any]:
    """The fields of the page's wizard as they stand, but for those that offer a choice."""
    return {str(each["name"]): each.get("value") or "" for each in page.all("input") if each.get("type") != "checkbox"}


def filled(visitor: Visitor, task: str, **changes: Any) -> dict[str, Any]:
    fields = inputs(visitor.page(f"/submit/task/{task}")) | {"queue": "default", "train.algorithm": "ppo"}
    return fields | {name.replace("__", "."): value for name, value in changes.items()}


def checked(visitor: Visitor, fields: dict[str, Any], **more: str) -> dict[str, Any]:
    token = visitor.page("/").form_token
    sent = {"form_token": token, **fields, **more}
    answer = visitor.http.post("/submit/check", data=sent, headers={"Accept": "application/json"})
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def yaml_of(page: Page) -> str:
    (kept, *_) = page.all("input", name="yaml")
    return str(kept["value"])
