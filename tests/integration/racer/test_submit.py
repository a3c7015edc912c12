"""The racer's wizard and the code that is typed into it, through a real server."""

from __future__ import annotations

import json
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from orchestrator.spec import strict_yaml
from tests.support.console.fixtures import Console
from tests.support.console.visitor import Page, Visitor
from tests.support.console.wizard import HOSTILE, checked, filled, inputs, yaml_of

REWARD = "def reward_function(params):\r\n    return params['speed']\r\n"


def test_a_reward_function_is_checked_as_it_is_typed_and_tried_when_its_editor_is_left(console: Console) -> None:
    visitor, name = console.visitor(), "train.config.reward_function"
    fields = filled(visitor, "Racer", **{"train__config__track": ["oval", "", "random:7"]})
    fields["train.hyperparameters.lr"] = "1e-4"
    message = checked(visitor, {**fields, name: REWARD})
    job, lines = strict_yaml.load(message["yaml"])
    assert message["problem"] is None and job["train"]["config"]["track"] == ["oval", "random:7"]
    assert job["train"]["config"]["reward_function"]["text"] == REWARD.replace("\r\n", "\n")
    forbidden = checked(visitor, {**fields, name: "import os\n" + REWARD})
    assert (forbidden["problem"]["key"], forbidden["problem"]["code_line"]) == (name, 1)
    assert forbidden["problem"]["line"] == lines["train", "config", "reward_function", "text"] + 1
    assert "os can't be imported" in forbidden["problem"]["message"]
    fails = {**fields, name: REWARD.replace("speed", "sped")}
    assert checked(visitor, fails)["problem"] is None
    problem = checked(visitor, fails, whole="yes")["problem"]
    assert problem["code_line"] == 2 and re.match(r"reward_function\.py:2: TEST_FAILURE: .*sped", problem["message"])
    answer = visitor.http.post("/submit/review", data=fails)
    assert answer.status_code == 400 and Page(answer.text).all("div", **{"data-line": "2"})
    assert visitor.http.post("/submit/review", data={**fields, name: REWARD}).status_code == 200


def test_the_code_of_a_key_of_some_queues_is_read_here_and_run_by_its_job_alone(console: Console) -> None:
    visitor, name = console.visitor("lab"), "train.config.reward_function"
    fields = {**filled(visitor, "Racer"), "queue": "lab", "resources.cpus": "1"}
    fails = {**fields, name: REWARD.replace("speed", "sped")}
    assert checked(visitor, fails, whole="yes")["problem"] is None
    assert "os can't" in checked(visitor, {**fields, name: "import os\n" + REWARD}, whole="yes")["problem"]["message"]
    page = visitor.page("/submit/task/Racer")
    assert "the job's ranks try it" in page.text
    assert "lab" in page.text and "default" not in [each.get("value") for each in page.all("option")]


def test_the_wizard_offers_tracks_hyperparameters_and_editors_of_code(visitor: Visitor) -> None:
    racer = visitor.page("/submit/task/Racer")
    assert {"train.hyperparameters.lr", "train.config.track", "train.config.lidar.rays"} <= set(inputs(racer))
    assert [each["value"] for each in racer.all("input", type="checkbox")] == ["oval", "rounded-rectangle", "chicane"]
    assert len(racer.all("textarea")) == 2


def test_code_is_text_wherever_it_is_shown(console: Console) -> None:
    visitor, name = console.visitor(), "train.config.reward_function"
    fields = filled(visitor, "Racer", **{"train__config__track": HOSTILE})
    code = f"{REWARD}# {HOSTILE}\r\n"
    for path, sent in (
        ("/submit/review", {**fields, name: code}),
        ("/submit/review", {**fields, name: code, "train.config.track": "oval"}),
        ("/submit/task/Racer", {**fields, name: code}),
        ("/submit/yaml", {**fields, name: code}),
    ):
        text = visitor.http.post(path, data=sent).text
        assert Page(text).is_inert and "<script>alert" not in text and "&lt;script&gt;alert" in text, (path, text)


@pytest.mark.parametrize(
    ("text", "words", "line"),
    [
        ("name: x\ntrain: {task: Racer, worlds: 1, iterations: 1, hyperparameters: a.json}", "a file is read", 2),
        (
            "name: x\ntrain:\n  task: Racer\n  worlds: 1\n  iterations: 1\n  config:\n    reward_function: /etc/passwd\n",
            "write what the file holds",
            7,
        ),
    ],
)
def test_a_path_of_the_server_in_a_request_is_refused_at_its_line(
    visitor: Visitor, text: str, words: str, line: int
) -> None:
    problem = checked(visitor, {"yaml": text})["problem"]
    assert words in problem["message"] and problem["line"] == line and "root:" not in problem["message"]
    assert words in visitor.submit("/submit", yaml=text).json()["message"]


def test_checks_of_the_longest_reward_functions_take_turns_and_leave_the_server_to_others(console: Console) -> None:
    visitor = console.visitor("lab")
    code = "def reward_function(params):\n    return 1.0\nx = 1" + "<1" * 60_000
    begins = (
        "name: a\nqueue: lab\ntrain:\n  task: Racer\n  worlds: 1\n  iterations: 1\n  config:\n    reward_function: "
    )
    text = f"{begins}{json.dumps({'file': 'r.py', 'text': code})}\n"
    token = visitor.page("/").form_token
    sent = {"form_token": token, "yaml": text, "whole": "yes"}

    def check(_: int) -> httpx.Response:
        return visitor.http.post("/submit/check", data=sent, headers={"Accept": "application/json"}, timeout=60)

    with ThreadPoolExecutor(12) as threads:
        answers = threads.map(check, range(12))
        for _ in range(20):
            assert visitor.http.get("/healthz").status_code == 200
        assert {answer.status_code for answer in answers} <= {200, 429}
    longer = checked(visitor, {"yaml": text.replace("<1" * 60_000, "<1" * 71_000)}, whole="yes")
    assert "140000 characters" in longer["problem"]["message"]
    token = visitor.page("/").form_token
    refused = visitor.http.post("/submit/check", data={"form_token": token, "yaml": text + "#" * 80_000})
    assert refused.status_code == 413


def test_a_reward_function_that_is_tried_tells_nothing_of_the_server(console: Console) -> None:
    """It passes the guard's look at the text; the files are there, and the server can read them."""
    visitor = console.visitor()
    for path in (console.server.home / "sealing.key", Path("/etc/passwd"), Path("/proc/self/environ")):
        assert path.read_bytes()
        code = "import numpy as np\n\n\ndef reward_function(params):\n"
        code += f"    lines = np.ma.core.inspect.linecache.getlines({str(path)!r})\n    raise ValueError(lines)\n"
        train = {
            "task": "Racer",
            "worlds": 1,
            "iterations": 1,
            "config": {"reward_function": {"file": "r.py", "text": code}},
        }
        problem = checked(visitor, {"yaml": json.dumps({"name": "a", "queue": "lab", "train": train})}, whole="yes")[
            "problem"
        ]
        assert problem["message"].endswith(
            "r.py:5: FORBIDDEN: the sample 'start': inspect can't be used in a reward function, on track oval with 133 waypoints"
        )


def test_a_long_reward_function_is_kept_beside_the_job_and_shown_with_it(console: Console) -> None:
    visitor, name = console.visitor("lab"), "train.config.reward_function"
    code = f"{REWARD}LINE = {[[round(0.001 * number, 3)] * 3 for number in range(1500)]!r}\r\n"
    fields = {**filled(visitor, "Racer"), "queue": "lab", "resources.cpus": "1", name: code}
    found = checked(visitor, fields)
    size = len(code.replace("\r\n", "\n"))
    assert (found["problem"], found["notes"]) == (
        None,
        [f"{name}: reward_function.py: {size:,} bytes: kept beside the job"],
    )
    review = visitor.http.post("/submit/review", data=fields)
    assert review.status_code == 200 and f"{size:,} bytes: kept beside the job" in Page(review.text).text
    job = visitor.submit("/submit", yaml=yaml_of(Page(review.text))).json()["location"].rpartition("/")[2]
    try:
        spec = console.client.get(f"/api/jobs/{job}")["spec"]
        assert spec["train"]["config"]["reward_function"].keys() == {"file", "sha256"}
        line = "LINE = [[0.0, 0.0, 0.0], [0.001, 0.001, 0.001]"
        assert line in visitor.page(f"/jobs/{job}").text
        again = visitor.page(f"/submit/yaml?job={job}")
        assert line in again.text and "sha256" not in again.text
    finally:
        console.client.batch("TerminateJob", jobId=job, reason="seen")
