"""The live view inside the page of a job: Rerun's viewer in a frame, of a real training."""

from __future__ import annotations

import re

from playwright.sync_api import Browser, expect

from tests.conftest import Serving
from tests.support.console.person import Person

TRAINING = """
name: watched
resources: {cpus: 1, memory: 2GiB}
train: {task: Cartpole, worlds: 16, iterations: 100000}
"""


def test_a_training_is_watched_in_its_page_and_the_viewer_ends_with_it(server: Serving, chromium: Browser) -> None:
    (server.home / "job.yaml").write_text(TRAINING)
    submitted = server.muster("submit", str(server.home / "job.yaml"))
    assert submitted.returncode == 0, submitted.stderr
    server.wait("watched", "RUNNING")
    person = Person(chromium, server.url)
    page = person.goto("/jobs/watched")
    job = page.url.rpartition("/")[2]
    person.click("Show its worlds")
    frame = page.locator("iframe.view")
    expect(frame).to_be_visible()
    viewer = re.fullmatch(r"http://127\.0\.0\.1:\d+", frame.get_attribute("src") or "")
    assert viewer, "the viewer's own origin"
    expect(page.frame_locator("iframe.view").locator("canvas").first).to_be_visible()
    frame.scroll_into_view_if_needed()
    person.picture("live-view")
    assert all(each.startswith(("http://127.", "data:", "blob:")) for each in person.requested), "nobody else is asked"
    assert any(each.startswith(f"{viewer[0]}/re_viewer") for each in person.requested)
    policy = person.page.request.get(f"/jobs/{job}").headers["content-security-policy"]
    assert f"frame-src 'self' {viewer[0]};" in policy and "unsafe" not in policy
    framed = person.page.request.get(f"{viewer[0]}/?url=x").headers["content-security-policy"]
    assert f"frame-ancestors 'self' {server.url}" in framed
    person.click("Close the live view")
    expect(frame).to_have_count(0)
    server.client.batch("TerminateJob", jobId=job, reason="seen")
