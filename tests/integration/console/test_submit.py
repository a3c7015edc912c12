"""The wizard and the YAML editor, through a real server."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from orchestrator.spec import strict_yaml
from tests.support.console.fixtures import Console
from tests.support.console.visitor import Page, Visitor
from tests.support.console.wizard import HOSTILE, checked, filled, inputs, yaml_of

COMMAND = (
    "name: works\nqueue: lab\nresources: {cpus: 1, memory: 16}\ncommand: [echo, '</pre><script>alert(1)</script>']\n"
)


def test_every_installed_task_has_a_wizard_with_its_own_settings(visitor: Visitor) -> None:
    addresses = [str(each["href"]) for each in visitor.page("/submit").all("a", **{"class": "card plain"})]
    assert {"/submit/task/Ant", "/submit/task/CartpolePixels", "/submit/yaml"} <= set(addresses)
    names = inputs(visitor.page("/submit/task/Cartpole"))
    assert {"train.config.cart_limit", "train.config.rewards.alive", "train.ppo.gamma", "train.sac.tau"} <= set(names)
    assert not any(each.startswith("train.hyperparameters") for each in names)
    assert "did you mean Ant?" in visitor.page("/submit/task/Antt", 404).text


def test_the_wizard_shows_the_yaml_that_it_submits(console: Console, visitor: Visitor) -> None:
    supplied = {"worlds": "8", "ppo__gamma": "0.9", "ppo__learning_rate": "3e-4", "sac__tau": "0.1"}
    supplied = {f"train__{name}": value for name, value in supplied.items()}
    fields = filled(visitor, "Cartpole", **supplied, train__config__rewards__alive="0.2", nodes="{min: 1, max: 2}")
    result = checked(visitor, fields)
    assert result["problem"] is None and result["help"] is None
    job, _ = strict_yaml.load(result["yaml"])
    ppo = {"learning_rate": 0.0003, "gamma": 0.9}
    train = {"task": "Cartpole", "worlds": 8, "iterations": 100, "algorithm": "ppo", "ppo": ppo}
    assert job["train"] == {**train, "config": {"rewards": {"alive": 0.2}}}
    assert (job["nodes"], list(job)[:3]) == ({"min": 1, "max": 2}, ["name", "queue", "nodes"])
    review = Page(visitor.http.post("/submit/review", data=fields).text)
    assert yaml_of(review) == result["yaml"]
    assert "python -P -m worker.train" in review.text and "localhost" in review.text
    answer = visitor.submit("/submit", yaml=yaml_of(review))
    id_ = answer.json()["location"].rpartition("/")[2]
    assert answer.json()["message"] == f"submitted cartpole as {id_[:8]}"
    spec = console.client.get(f"/api/jobs/{id_}")["spec"]
    assert spec["train"]["ppo"] == ppo and spec["train"]["worlds"] == 8
    console.client.batch("TerminateJob", jobId=id_, reason="seen")
    again = visitor.http.get(f"/submit/yaml?job={id_}")
    assert again.status_code == 200 and "gamma: 0.9" in again.text
    assert "gamma" not in console.visitor("lab").page(f"/submit/yaml?job={id_}", 404).text
    back = Page(visitor.http.post("/submit/task/Cartpole", data=fields).text)
    assert inputs(back)["train.ppo.gamma"] == "0.9" and inputs(back)["nodes"] == "{min: 1, max: 2}"


def test_a_form_that_is_sent_again_leads_to_the_job_that_it_made(console: Console) -> None:
    visitor, other = console.visitor(), console.visitor("lab")
    answer = visitor.http.post("/submit/review", data={"form_token": visitor.page("/").form_token, "yaml": COMMAND})
    (once,) = Page(answer.text).all("input", name="once")
    fields = {"yaml": yaml_of(Page(answer.text)), "once": str(once["value"])}
    with ThreadPoolExecutor(4) as pool:
        answers = [each.json() for each in pool.map(lambda _: visitor.submit("/submit", **fields), range(4))]
    (place,) = {each["location"] for each in answers}
    assert sum(each["message"].startswith("submitted") for each in answers) == 1
    assert sum(each["message"].startswith("this form has already submitted") for each in answers) == 3
    lab = {**fields, "yaml": COMMAND.replace("works", "works-too")}
    others = [(other, lab), (visitor, {**fields, "once": "another"}), (visitor, {**fields, "once": ""})]
    jobs = [place, *(who.submit("/submit", **sent).json()["location"] for who, sent in others)]
    assert len(set(jobs)) == 4, "another person's form, another form, a form without a name"
    for each in jobs:
        console.client.batch("TerminateJob", jobId=each.rpartition("/")[2], reason="seen")


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("train.worlds", "many", "expected an integer"),
        ("train.config.rewards.alive", "[1]", "found"),
        ("train.ppo.gamma", "7", "7"),
        ("name", "a b", "expected letters"),
        ("nodes", "x", "expected an integer number of nodes"),
        ("timeout", "soon", "expected a duration"),
    ],
)
def test_a_wrong_value_is_shown_at_its_field(visitor: Visitor, field: str, value: str, words: str) -> None:
    fields = {**filled(visitor, "Cartpole"), field: value}
    problem = checked(visitor, fields)["problem"]
    assert problem["key"].startswith(field) and words in problem["message"] and problem["line"] > 0
    answer = visitor.http.post("/submit/review", data=fields)
    page = Page(answer.text)
    shown = [each for each in page.all("p", **{"class": "problem"}) if "data-wrong" in each and "hidden" not in each]
    assert answer.status_code == 400 and [each["data-wrong"] for each in shown] == [field]
    assert page.all("input", name=field)[0]["value"] == value and problem["message"] in page.text


def test_a_job_that_no_host_could_hold_is_refused_before_anything_is_registered(console: Console) -> None:
    visitor = console.visitor()
    fields = filled(visitor, "Cartpole", name="huge", resources__cpus="64")
    answer = visitor.http.post("/submit/review", data=fields)
    assert answer.status_code == 400 and "64" in Page(answer.text).text
    refused = visitor.submit("/submit", yaml=checked(visitor, fields)["yaml"])
    assert refused.status_code == 400
    assert console.client.batch("DescribeJobDefinitions", jobDefinitionName="huge")["jobDefinitions"] == []


def test_names_are_text_wherever_they_are_shown(console: Console) -> None:
    visitor = console.visitor()
    fields = filled(visitor, "Cartpole", **{"train__config__cart_limit": HOSTILE})
    for path, sent in (
        ("/submit/review", fields),
        ("/submit/task/Cartpole", fields),
        ("/submit/yaml", fields),
        ("/submit/review", {**fields, "name": HOSTILE, "train.worlds": HOSTILE}),
        ("/submit/review", {"form_token": fields["form_token"], "yaml": f"name: '{HOSTILE}'"}),
        ("/submit/review", {"form_token": fields["form_token"], "yaml": HOSTILE}),
    ):
        text = visitor.http.post(path, data=sent).text
        assert Page(text).is_inert and "<script>alert" not in text and "&lt;script&gt;alert" in text, (path, text)
    for path in (f"/submit/task/{HOSTILE}", f"/submit/yaml?job={HOSTILE}"):
        text = visitor.http.get(path).text
        assert Page(text).is_inert and "<script>alert" not in text


def test_any_job_is_submitted_as_yaml_with_help_for_the_line_and_its_errors_marked(console: Console) -> None:
    visitor = console.visitor()
    text = "name: x\nqueue: lab\ntrain:\n  task: Ant\n  worlds: 2\n  wordls: 3\n"
    result = checked(visitor, {"yaml": text.replace("\n", "\r\n")}, line="4")
    assert result["yaml"] == text
    assert (result["problem"]["key"], result["problem"]["line"]) == ("train.wordls", 6)
    assert "did you mean worlds?" in result["problem"]["message"]
    keys = {each["name"]: each for each in result["help"]["keys"]}
    assert result["help"]["section"] == "train" and keys["task"]["present"] and not keys["seed"]["present"]
    assert "name of a task" in result["help"]["key"]["about"]
    answer = visitor.http.post("/submit/review", data={"form_token": visitor.page("/").form_token, "yaml": text})
    assert answer.status_code == 400 and Page(answer.text).all("div", **{"data-line": "6"})
    sent = {"form_token": visitor.page("/").form_token, "yaml": COMMAND}
    review = Page(visitor.http.post("/submit/review", data=sent).text)
    assert yaml_of(review) == COMMAND and review.is_inert and "echo </pre><script>" in review.text
    job = visitor.submit("/submit", yaml=COMMAND).json()["location"].rpartition("/")[2]
    found = console.client.get(f"/api/jobs/{job}")
    assert (found["queue"], found["name"], found["owner"]) == ("lab", "works", "key admin")


@pytest.mark.parametrize(
    ("text", "words", "line"),
    [
        ("name: [", "not valid YAML", 1),
        ("a: &x 1\nb: *x\n", "anchors and aliases", 1),
        ("", "expected an object", 0),
    ],
)
def test_what_a_request_must_not_bring_is_shown_at_its_line(visitor: Visitor, text: str, words: str, line: int) -> None:
    problem = checked(visitor, {"yaml": text})["problem"]
    assert words in problem["message"] and problem["line"] == line and "root:" not in problem["message"]
    assert words in visitor.submit("/submit", yaml=text).json()["message"]


def test_a_read_only_key_and_a_key_of_another_queue_submit_nothing(console: Console) -> None:
    reader = console.visitor("reader")
    for path in ("/submit", "/submit/task/Ant", "/submit/yaml"):
        assert "is read-only" in reader.page(path, 403).text
    for path in ("/submit", "/submit/check", "/submit/review", "/submit/yaml", "/submit/task/Ant"):
        assert "is read-only" in reader.refusal(path, yaml=COMMAND), path
    lab = console.visitor("lab")
    assert "limited to job queue lab" in lab.refusal("/submit", yaml=COMMAND.replace("queue: lab", "queue: default"))
    token = lab.page("/").form_token
    stolen = lab.http.post("/submit", data={"form_token": token[:-1] + "x", "yaml": COMMAND})
    assert stolen.status_code == 403 and "reload the page" in stolen.text
