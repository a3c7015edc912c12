"""Sources of jobs' secrets, and the message where one can't be supplied."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from orchestrator.engines.secrets import Secrets, SecretsError
from tests.support.refusals import refusal

MANAGER = "arn:aws:secretsmanager:us-east-1:123456789012:secret:"


def asking(value_from: str) -> dict[str, Any]:
    return {"secrets": [{"name": "PASSWORD", "valueFrom": value_from}]}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "secrets.json"
    path.touch(0o600)
    login = {"user": "me", "key": 7}
    path.write_text(json.dumps({"db": "hunter2", "token": "abc", "login": login, "text": '{"a": "b"}'}))
    return path


@pytest.mark.parametrize(
    ("value_from", "value"),
    [
        ("db", "hunter2"),
        (f"{MANAGER}db-AbCdEf", "hunter2"),
        (f"{MANAGER}db", "hunter2"),
        ("arn:aws:ssm:us-east-1:123456789012:parameter/prod/token", "abc"),
        (f"{MANAGER}login-AbCdEf:key::", "7"),
        (f"{MANAGER}text-AbCdEf:a::", "b"),
        ("login", '{"user": "me", "key": 7}'),
    ],
)
def test_a_secret_is_found_by_its_reference_or_by_the_name_in_it(file: Path, value_from: str, value: str) -> None:
    assert Secrets(str(file)).of(asking(value_from), "default") == {"PASSWORD": value}


def test_a_secret_with_a_zero_byte_is_refused(file: Path) -> None:
    file.write_text(json.dumps({"db": "hunter\0"}))
    with pytest.raises(SecretsError, match="secret PASSWORD: 'db' has a zero byte, which no variable can have"):
        Secrets(str(file)).of(asking("db"), "default")


def test_a_secret_of_some_queues_is_given_to_their_jobs_alone(file: Path) -> None:
    secrets = Secrets(str(file))
    kept = {"value": {"key": "abc"}, "queues": ["robots"]}
    file.write_text(json.dumps({"token": kept, "broken": {"value": "abc", "queues": "robots"}}))  # read at each launch
    assert secrets.of(asking(f"{MANAGER}token:key::"), "robots") == {"PASSWORD": "abc"}
    for name, queue in (("token", "lab"), ("token", "robot"), ("broken", "robots")):
        with pytest.raises(SecretsError, match=f"'{name}' is not for job queue {queue}; add the queue in") as output:
            secrets.check([asking(name)], queue)
        assert "abc" not in str(output.value)


def test_variables_leave_the_controllers_environment() -> None:
    environment = {"MUSTER_SECRET_prod_db": "hunter2", "PATH": "/bin"}
    secrets = Secrets("env", environment)
    assert environment == {"PATH": "/bin"}, "or every node would inherit them"
    for name in ("arn:aws:ssm:us-east-1:123456789012:parameter/prod/db", "prod/db"):
        assert secrets.of(asking(name), "default") == {"PASSWORD": "hunter2"}


@pytest.mark.parametrize(
    ("value_from", "message"),
    [
        ("other", "'other' is not in"),
        (f"{MANAGER}login:nope::", "has no key 'nope'"),
        (f"{MANAGER}db:a::", "has no key 'a'"),
    ],
)
def test_a_missing_secret_is_named_without_a_value(file: Path, value_from: str, message: str) -> None:
    output = refusal(Secrets(str(file)).of, asking(value_from), "default", error=SecretsError)
    assert message in output and "hunter2" not in output


def test_a_controller_gives_no_secrets_unless_it_was_configured_to(file: Path) -> None:
    assert Secrets().of({"secrets": []}, "default") == {}
    with pytest.raises(SecretsError, match="muster serve --secrets"):
        Secrets().of(asking("db"), "default")
    environment = {"MUSTER_SECRET_db": "hunter2", "HOME": "/"}
    Secrets(str(file), environment)
    assert environment == {"HOME": "/"}, "a process of a job would inherit it"
    file.chmod(0o640)
    with pytest.raises(SecretsError, match="chmod 600"):
        Secrets(str(file))
    with pytest.raises(SecretsError, match="No such file"):
        Secrets(str(file.parent / "none"))
    for text, message in (("[]", "expected a JSON object"), ("{", "not JSON")):
        file.write_text(text)
        file.chmod(0o600)
        with pytest.raises(SecretsError, match=message):
            Secrets(str(file))
