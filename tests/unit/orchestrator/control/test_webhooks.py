"""The file of webhooks, which jobs each gets, what of them, and the signature."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from orchestrator.control.deliveries import _evaluated
from orchestrator.control.webhooks import PAUSES, Webhook, WebhooksError, kind_of, read_webhooks, run_of
from orchestrator.persistence.batch_models import Job
from shared_store.volume.files import write_json
from shared_store.volume.layout import Store
from tests.support.orchestrator.receiver import SECRET, write_webhooks
from tests.support.orchestrator.rows import job
from tests.support.orchestrator.trained import add_checkpoint, add_run
from tests.support.refusals import refusal

URL = "https://chat.example:8443/hooks/T0/secret"


def test_a_message_is_signed_as_the_example_of_standard_webhooks_and_tried_for_about_eleven_hours() -> None:
    webhook = Webhook(url=URL, secret=SECRET)
    headers = webhook.headers("msg_p5jXN8AQM9LWM0D4loKWxJek", 1614265330, b'{"test": 2432232314}')
    assert headers["webhook-signature"] == "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="
    assert headers["webhook-id"] == "msg_p5jXN8AQM9LWM0D4loKWxJek" and headers["webhook-timestamp"] == "1614265330"
    assert len(PAUSES) == 7 and 10.5 < sum(PAUSES) / 3600 < 11.5
    assert all(later == 5 * earlier for earlier, later in itertools.pairwise(PAUSES))


def test_the_file_names_receivers_whose_secrets_and_paths_are_not_shown(tmp_path: Path) -> None:
    path = write_webhooks(tmp_path / "hooks.json", chat={"url": URL, "statuses": ["FAILED"]}, log={"url": URL})
    chat, log = read_webhooks(path)
    assert (chat.name, chat.receiver, chat.statuses) == ("chat", "https://chat.example:8443", ["FAILED"])
    assert (log.statuses, log.queues, log.kinds) == (["SUCCEEDED", "FAILED"], None, None)
    assert SECRET not in repr(chat)


SHORT = "whsec_c2hvcnQ="


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"url": "chat.example"}, "chat.url: expected a URL such as https://chat.example/hooks/muster"),
        ({"url": "file:///etc/passwd"}, "chat.url: expected a URL such as https://chat.example/hooks/muster"),
        ({"secret": SHORT}, "chat.secret: expected whsec_ and 24 to 64 random bytes in base64"),
        ({"secret": SECRET.removeprefix("whsec_")}, "chat.secret: expected whsec_ and 24 to 64 random bytes"),
        ({"secret": 7}, "chat.secret: expected a string"),
        ({"secrt": "x"}, "chat.secrt: unknown key; valid here: url, secret, statuses, queues, kinds, link"),
        ({"statuses": ["DONE"]}, "chat.statuses"),
    ],
)
def test_a_mistake_is_reported_in_one_line_without_a_secret(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    path = write_webhooks(tmp_path / "hooks.json", chat={"url": URL, **changes})
    reported = refusal(read_webhooks, path, error=WebhooksError)
    assert words in reported and reported.startswith(f"{path}: ") and "\n" not in reported
    for secret in (SECRET, SHORT, SECRET.removeprefix("whsec_")):
        assert secret not in reported


def test_a_missing_or_publicly_readable_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hooks.json"
    with pytest.raises(WebhooksError, match=r"webhooks can't be read \(No such file or directory\)$"):
        read_webhooks(str(path))
    write_webhooks(path, chat={"url": URL})
    path.chmod(0o644)
    with pytest.raises(WebhooksError, match="others can read these secrets; chmod 600"):
        read_webhooks(str(path))
    path.chmod(0o600)
    for text in ("{", "[]", '{"a b": {}}', '{"a": {"name": "b"}}'):
        path.write_text(text)
        with pytest.raises(WebhooksError, match=r"not JSON|expected a JSON object|is not a name for a webhook"):
            read_webhooks(str(path))


def ended(status: str = "FAILED", queue: str = "robots", parent: str | None = None, spec: str = "") -> Job:
    environment = [{"name": "MUSTER_SPEC", "value": spec}] if spec else []
    ranges = [{"targetNodes": "0:", "container": {"environment": environment}}]
    properties = {"numNodes": 1, "mainNode": 0, "nodeRangeProperties": ranges}
    return Job(id="j", name="n", queue=queue, status=status, parent=parent, node_properties=properties)


def test_a_webhook_gets_its_states_queues_and_kinds_arrays_as_a_whole_and_damaged_jobs_as_commands() -> None:
    webhook = Webhook(url=URL, secret=SECRET, statuses=["FAILED"], queues=["robots"], kinds=["train"])
    train = json.dumps({"train": {"task": "Ant"}})
    assert webhook.wants(ended(spec=train))
    assert not webhook.wants(ended("SUCCEEDED", spec=train)) and not webhook.wants(ended(queue="lab", spec=train))
    assert not webhook.wants(ended(spec=json.dumps({"evaluate": {"run": "x"}})))
    everything = Webhook(url=URL, secret=SECRET)
    assert everything.wants(ended("SUCCEEDED", "lab")) and not everything.wants(ended("RUNNING"))
    assert not everything.wants(ended(parent="array"))
    assert kind_of(ended(spec="{")) == kind_of(Job(id="j", own_node_properties={})) == "command"


def test_an_evaluation_tells_of_itself_and_a_training_of_its_newest_checkpoint(tmp_path: Path) -> None:
    store = Store(tmp_path)
    add_run(store, "taught")
    for iteration in (3, 6):
        add_checkpoint(store, "taught", iteration)
    run = store.run("taught")
    figures = {"mean_length": 9.0, "max_length": 10, "episodes": 4, "time": 1.0}
    write_json(run.evaluations / "00000003-e1-1f2e3d4c.json", {**figures, "mean_return": 3.0})
    write_json(run.evaluations / "00000006-e1.json", {**figures, "mean_return": 6.0})

    def reported(job_id: str, spec: dict[str, object]) -> tuple[str | None, float | None]:
        environment = [{"name": "MUSTER_SPEC", "value": json.dumps(spec)}]
        ranges = [{"targetNodes": "0:", "container": {"environment": environment}}]
        properties = {"numNodes": 1, "mainNode": 0, "nodeRangeProperties": ranges}
        about = job(job_id, run="taught" if "train" in spec else "evaluate-taught", node_properties=properties)
        assert run_of(about) == "taught"
        checkpoint, summary = _evaluated(run, about)
        return checkpoint, summary and summary["mean_return"]

    assert reported("1f2e3d4c-5b6a", {"evaluate": {"run": "taught"}}) == ("00000003-e1", 3.0)
    assert reported("99999999-5b6a", {"evaluate": {"run": "taught"}}) == (None, None), "it failed before it had one"
    assert reported("99999999-5b6a", {"train": {"task": "Cartpole"}}) == ("00000006-e1", 6.0)
