"""A server that is killed and started again while people look."""

from __future__ import annotations

import re

from playwright.sync_api import expect

from tests.conftest import Serving
from tests.support.console.person import People

LINES = 400
SCRIPT = f"""
import time
for i in range({LINES}):
    print("line", i, flush=True)
    time.sleep(0.05)
"""


def test_no_line_is_lost_when_the_server_is_killed_while_two_people_look(server: Serving, people: People) -> None:
    job = server.gang(SCRIPT)
    reader, watcher = people(server.url), people(server.url)
    page = reader.goto(f"/jobs/{job}")
    expect(page.get_by_role("log")).to_contain_text("line 20")
    row = watcher.goto("/").locator(f'tr[data-key="{job}"] .badge')
    expect(row).to_have_text("RUNNING")
    port = server.url.rpartition(":")[2]
    server.kill()
    for each in (reader, watcher):
        expect(each.page.locator("[data-link]")).to_contain_text("connection lost")
    server.options = (*server.options, "--port", port)
    server.start()
    expect(page.locator(".headline .badge")).to_have_text("SUCCEEDED")
    expect(row).to_have_text("SUCCEEDED")
    expect(page.get_by_role("log")).to_contain_text(f"line {LINES - 1}")
    output = page.locator("[data-log] .line").all_text_contents()
    numbers = [int(found[1]) for each in output if (found := re.search(r"\bline (\d+)$", each))]
    assert numbers == list(range(LINES)), "every line once, in its order"
    for each in (reader, watcher):
        expect(each.page.locator("[data-link]")).to_be_hidden()
