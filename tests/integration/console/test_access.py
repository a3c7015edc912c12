"""Who gets into the console, what a browser may be made to do, what other web pages can't, and the page of keys."""

from __future__ import annotations

import contextlib
from pathlib import Path

import httpx
import pytest

from orchestrator.console.pages import NAVIGATION
from tests.conftest import Serving, wait_for
from tests.support.console.fixtures import Console, secret_of
from tests.support.console.visitor import Page, Visitor
from tests.support.keys import HomeKeys


def test_a_browser_without_a_session_is_sent_to_the_login_and_back(console: Console) -> None:
    http = httpx.Client(base_url=console.url, headers={"Accept": "text/html"}, trust_env=False)
    sent = http.get("/?search=a%26b")
    assert sent.status_code == 303 and sent.headers["location"] == "/login?next=%2F%3Fsearch%3Da%2526b"
    question = Page(http.get(sent.headers["location"]).text)
    (kept,) = question.all("input", name="next")
    answer = http.post("/login", data={"next": str(kept["value"]), "key": console.secrets["admin"]})
    assert answer.status_code == 303 and answer.headers["location"] == "/?search=a%26b"
    assert http.get("/?search=a%26b").status_code == 200


def test_a_program_without_a_key_still_gets_an_error_that_it_can_read(console: Console) -> None:
    answer = httpx.get(f"{console.url}/", trust_env=False)
    assert (answer.status_code, answer.headers["x-amzn-errortype"]) == (403, "MissingAuthenticationToken")


def test_a_wrong_key_is_refused_and_opens_nothing(console: Console) -> None:
    name = console.secrets["admin"].partition(":")[0]
    for supplied in ("", "x", name, f"{name}:x", "MSTRAAAAAAAAAAAAAAAA:x", "ä\N{SNOWMAN}"):
        answer = httpx.post(f"{console.url}/login", data={"key": supplied}, trust_env=False)
        assert answer.status_code == 403 and "this key is unknown" in answer.text and "set-cookie" not in answer.headers


def test_the_cookie_is_not_the_key_and_no_script_or_other_site_gets_it(console: Console) -> None:
    secret = console.secrets["admin"]
    answer = httpx.post(f"{console.url}/login", data={"key": secret}, trust_env=False)
    cookie = answer.headers["set-cookie"]
    assert secret.partition(":")[2] not in cookie
    assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(cookie.split("; "))


@pytest.mark.parametrize(
    "elsewhere",
    ["//evil.example", "https://evil.example/", "/\\evil.example", "\\evil", "javascript:x", "/ x", "/\tx", "//[", ""],
)
def test_a_login_leads_nowhere_else(console: Console, elsewhere: str) -> None:
    supplied = {"next": elsewhere, "key": console.secrets["admin"]}
    answer = httpx.post(f"{console.url}/login", data=supplied, trust_env=False)
    assert answer.status_code == 303 and answer.headers["location"] == "/"


def test_a_logged_out_session_is_over_wherever_it_was_copied_to(console: Console) -> None:
    visitor, thief = console.visitor(), httpx.Client(base_url=console.url, headers={"Accept": "text/html"})
    thief.cookies = visitor.http.cookies.__class__(visitor.http.cookies)
    assert thief.get("/").status_code == 200
    assert visitor.submit("/logout").status_code == 200
    assert thief.get("/").status_code == 303
    thief.close()


def test_a_session_ends_with_its_key_and_outlives_a_restart_of_the_server(tmp_path: Path) -> None:
    keys = HomeKeys(tmp_path)
    keys.create("other")
    key = keys.create("mine")
    with Serving(tmp_path, "--cpus", "1") as server, contextlib.closing(Visitor(server.url, secret_of(key))) as visitor:
        token = visitor.page("/").form_token
        server.kill()
        server.options = (*server.options, "--port", server.url.rpartition(":")[2])
        server.start()
        assert visitor.page("/").form_token == token, "forms of open pages go on"
        keys.delete("mine")
        wait_for(lambda: visitor.http.get("/", follow_redirects=False).status_code == 303, what="the look at the keys")


@pytest.mark.parametrize("way", ["deleted key", "logout"])
def test_a_stream_ends_with_its_readers_session(console: Console, way: str) -> None:
    visitor = Visitor(console.url, secret_of(console.keys.create("passing")))
    other = httpx.Client(base_url=console.url, cookies=visitor.http.cookies, headers={"Accept": "text/html"})
    with visitor.http.stream("GET", "/jobs/stream", headers={"Accept": "text/event-stream"}) as answer:
        lines = answer.iter_lines()
        assert next(lines).startswith(":"), "the stream is open"
        if way == "logout":
            token = Page(other.get("/").text).form_token
            assert other.post("/logout", data={"form_token": token}).status_code == 303
        else:
            console.keys.delete("passing")
        assert "event: end" not in list(lines), "the browser comes back, and is asked who it is"
    question = other.head("/jobs/stream", headers={"Accept": "text/html"})
    assert question.status_code == 303 and question.headers["location"].startswith("/login")
    if way == "logout":
        console.keys.delete("passing")
    other.close()
    visitor.close()


def test_a_session_reads_the_api_and_changes_nothing_through_it(visitor: Visitor) -> None:
    assert visitor.http.get("/api/jobs").json()["jobs"] == []
    assert "GET /api/jobs" in visitor.page("/api/docs").text
    for path in ("/v1/createjobqueue", "/api/jobs", "/"):
        headers = {"Accept": "*/*", "X-Amz-Target": "Logs_20140328.DescribeLogGroups"}
        answer = visitor.http.post(path, json={}, headers=headers)
        assert answer.status_code == 403 and answer.headers["x-amzn-errortype"] == "MissingAuthenticationToken", path


def test_a_change_needs_the_token_of_a_form_of_the_same_session(console: Console) -> None:
    visitor, other = console.visitor(), console.visitor("lab")
    token = visitor.page("/").form_token
    for supplied in ("", "x", "ä", other.page("/").form_token):
        answer = visitor.http.post("/jobs/stop", data={"form_token": supplied, "job": "x", "confirmed": "yes"})
        assert answer.status_code == 403 and "reload the page" in answer.text
    answer = visitor.http.post("/jobs/stop", data={"form_token": token})
    assert answer.status_code == 400 and "no job" in answer.text


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"},
        {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "script"},
        {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "iframe"},
        {"Host": "evil.example"},
    ],
)
def test_another_web_page_can_use_no_open_server(shared_server: Serving, headers: dict[str, str]) -> None:
    visitor = Visitor(shared_server.url)
    token = visitor.page("/").form_token
    for path in ("/", "/jobs/stream", "/api/jobs", "/login", "/static/x/console.js"):
        answer = visitor.http.get(path, headers=headers)
        assert answer.status_code == 403 and "AccessDenied" in answer.text, path
    sent = {"form_token": token, "job": "x", "confirmed": "yes"}
    changed = visitor.http.post("/jobs/stop", data=sent, headers=headers)
    assert changed.status_code == 403
    link = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}
    assert visitor.http.get("/", headers=link).status_code == 200, "a link that a person follows"
    visitor.close()


def test_every_page_loads_its_own_files_alone_and_has_the_strict_policy(console: Console, visitor: Visitor) -> None:
    pages = [visitor.http.get(path) for path in ("/", "/?search=x", "/nowhere", "/?status=x")]
    pages.append(httpx.get(f"{console.url}/login", trust_env=False))
    for answer in pages:
        policies = answer.headers.get_list("content-security-policy")
        assert any("default-src 'none'; script-src 'self'; style-src 'self'" in each for each in policies), answer.url
        assert "unsafe" not in "".join(policies) and "frame-ancestors 'none'" in "".join(policies)
        assert answer.headers["cache-control"] == "no-store"
        assert Page(answer.text).is_inert, answer.text


@pytest.mark.parametrize(("name", "hidden"), [("admin", set()), ("reader", {"/submit"}), ("lab", {"/keys"})])
def test_the_navigation_leads_to_every_page_that_is_not_refused(console: Console, name: str, hidden: set[str]) -> None:
    visitor = console.visitor(name)
    paths = {entry.path for entry in NAVIGATION}
    assert paths - {each.get("href") for each in visitor.page("/").all("a")} == hidden
    for path in paths:
        visitor.page(path, 403 if path in hidden else 200)


def test_files_are_kept_for_ever_under_the_address_of_their_content_and_no_other_is_given_out(console: Console) -> None:
    visitor = console.visitor()
    (script,) = visitor.page("/").all("script")
    answer = httpx.get(f"{console.url}{script['src']}", trust_env=False)
    assert "immutable" in answer.headers["cache-control"]
    assert answer.headers["content-type"].startswith("text/javascript")
    old = httpx.get(f"{console.url}/static/0/console.js", trust_env=False)
    assert old.text == answer.text and old.headers["cache-control"] == "no-store"
    for name in ("../__init__.py", "..%2f__init__.py", "nothing.js"):
        assert httpx.get(f"{console.url}/static/0/{name}", trust_env=False).status_code in (403, 404)


def test_an_address_that_leads_nowhere_is_a_page_for_browsers_and_json_for_programs(visitor: Visitor) -> None:
    assert "Not Found" in visitor.page("/nowhere", 404).text
    result = visitor.http.get("/nowhere", headers={"Accept": "*/*"})
    assert result.status_code == 404 and result.json()["message"] == "GET /nowhere: Not Found"


# -- the page of keys --------------------------------------------------------------------------------------------------


def post(visitor: Visitor, path: str, **fields: str | list[str]) -> httpx.Response:
    """Send a form of the page as a browser without scripts does."""
    return visitor.http.post(path, data={"form_token": visitor.page("/keys").form_token, **fields})


def test_the_list_tells_what_each_key_may_do_and_no_secret(console: Console) -> None:
    page = console.visitor().page("/keys")
    for text in ("admin you", "all queues, read only", "queues lab, read and write"):
        assert text in page.text
    assert not any(secret.partition(":")[2] in page.source for secret in console.secrets.values())
    assert [each["name"] for each in console.client.get("/api/keys")] == ["admin", "lab", "reader"]
    assert "secret" not in str(console.client.get("/api/keys")).lower()


def test_a_key_is_made_its_secret_is_shown_once_and_it_works(console: Console) -> None:
    answer = post(
        console.visitor(), "/keys/create", name="alice", queue=["lab", "default"], read_only="yes", share="team"
    )
    (key,) = [key for key in console.keys.load().values() if key.name == "alice"]
    assert (key.queues, key.read_only, key.share) == (("lab", "default"), True, "team")
    assert answer.status_code == 200 and f"MUSTER_TOKEN={secret_of(key)}" in answer.text
    assert answer.headers["cache-control"] == "no-store"
    alice = Visitor(console.url, secret_of(key))
    assert "key alice" in alice.page("/").text
    alice.close()
    page = console.visitor().page("/keys")
    assert key.secret not in page.source and "read only team" in page.text
    wrong = post(console.visitor(), "/keys/create", name="carol", share="a-b")
    assert wrong.status_code == 400 and "--share 'a-b': 1 to 255 letters and digits" in Page(wrong.text).text
    again = post(console.visitor(), "/keys/create", name="alice")
    assert again.status_code == 400 and "there is a key alice already" in Page(again.text).text


def test_a_key_is_deleted_once_the_person_has_confirmed(console: Console) -> None:
    key = console.keys.create("bob")
    bob, visitor = Visitor(console.url, secret_of(key)), console.visitor()
    stream = visitor.events("/keys/stream")
    assert "bob" in next(stream)[1]["keys"]["order"]
    question = visitor.submit("/keys/delete", name="bob")
    assert question.status_code == 409 and question.json()["question"]["title"] == "Delete key bob?"
    assert bob.http.get("/", follow_redirects=False).status_code == 200
    result = visitor.submit("/keys/delete", name="bob", confirmed="yes").json()
    assert result == {"location": "/keys", "message": "deleted key bob"}
    assert "bob" not in next(stream)[1]["keys"]["order"]
    stream.close()
    assert bob.http.get("/", follow_redirects=False).status_code == 303
    bob.close()
    assert "key 'bob' does not exist" in visitor.submit("/keys/delete", name="bob", confirmed="yes").json()["message"]
    own = visitor.submit("/keys/delete", name="admin").json()["question"]["text"]
    assert "It is your own key: you will be logged out." in own and "last key" not in own


def test_only_keys_with_all_queues_see_keys_and_a_read_only_one_changes_none(console: Console) -> None:
    lab, reader = console.visitor("lab"), console.visitor("reader")
    assert "limited to job queue lab" in lab.page("/keys", 403).text
    for visitor, output in ((lab, "limited to job queue lab"), (reader, "is read-only")):
        made = visitor.submit("/keys/create", name="mine")
        gone = visitor.submit("/keys/delete", name="admin", confirmed="yes")
        for answer in (made, gone):
            assert answer.status_code == 403 and output in answer.json()["message"]
    page = reader.page("/keys")
    assert "admin" in page.text and [each["action"] for each in page.all("form", method="post")] == ["/logout"]
    assert {key.name for key in console.keys.load().values()} >= {"admin", "lab", "reader"}


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", "", '" onload="x', "a/b", "../x", "x" * 200])
def test_a_hostile_name_is_refused_as_text(console: Console, name: str) -> None:
    answer = post(console.visitor(), "/keys/create", name=name)
    page = Page(answer.text)
    assert answer.status_code == 400 and page.is_inert and "key name" in page.text
    queue = post(console.visitor(), "/keys/create", name="fine", queue=name)
    assert (queue.status_code == 400 and Page(queue.text).is_inert) or not name


def test_the_first_key_is_made_after_a_warning_and_from_then_on_everybody_needs_one(tmp_path: Path) -> None:
    with Serving(tmp_path, "--cpus", "1") as server, contextlib.closing(Visitor(server.url)) as visitor:
        assert "There is no key" in visitor.page("/keys").text
        question = post(visitor, "/keys/create", name="first")
        assert question.status_code == 409 and "everybody needs a key, you too" in Page(question.text).text
        made = post(visitor, "/keys/create", name="first", confirmed="yes")
        (key,) = HomeKeys(tmp_path).load().values()
        assert key.secret in made.text
        assert visitor.http.get("/keys", follow_redirects=False).headers["location"].startswith("/login")


def test_a_server_that_other_machines_can_reach_shows_keys_and_makes_none(tmp_path: Path) -> None:
    keys = HomeKeys(tmp_path)
    secret = secret_of(keys.create("admin"))
    with (
        Serving(tmp_path, "--cpus", "1", "--host", "0.0.0.0") as server,
        contextlib.closing(Visitor(server.url, secret)) as visitor,
    ):
        page = visitor.page("/keys")
        assert "muster keys create NAME" in page.text and not page.all("form", action="/keys/create")
        for path, fields in (("/keys/create", {"name": "x"}), ("/keys/delete", {"name": "admin", "confirmed": "yes"})):
            assert "other machines can reach this server" in visitor.refusal(path, **fields)
        bearer = {"Authorization": f"Bearer {secret}"}
        answer = httpx.post(f"{server.url}/api/keys", json={"name": "x"}, headers=bearer, trust_env=False)
        assert answer.status_code == 403 and [key.name for key in keys.load().values()] == ["admin"]
