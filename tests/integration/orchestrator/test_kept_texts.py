"""Long texts of jobs over the API: uploaded, named by definitions, copied into the run, lost, and never half there."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from orchestrator.domain.errors import ApiError
from shared_store.volume.texts import digest_of
from tests.conftest import Serving
from tests.support.definitions import container, multinode

READ = """
import hashlib, json, os, pathlib
named = json.loads(os.environ["MUSTER_SPEC"])["train"]["config"]["reward_function"]["sha256"]
path = pathlib.Path(os.environ["MUSTER_STORE"], "runs", os.environ["MUSTER_RUN"], "texts", named)
print("text", hashlib.sha256(path.read_bytes()).hexdigest() == named)
"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    with Serving(tmp_path_factory.mktemp("home"), "--cpus", "2") as server:
        yield server


def definition(name: str, text: str, command: list[str] | None = None) -> dict[str, Any]:
    """A job whose spec names a text, as a client without Muster's command registers it."""
    value = {"file": "mine.py", "sha256": digest_of(text)}
    spec = {"name": name, "train": {"task": "elsewhere.mine:Task", "config": {"reward_function": value}}}
    needs = container(command or ["python", "-c", READ], env={"MUSTER_SPEC": json.dumps(spec)})
    return multinode(name, needs)


def refused(server: Serving, operation: str, **request: Any) -> str:
    with pytest.raises(ApiError) as caught:
        server.client.batch(operation, **request)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def submitted(server: Serving, name: str, **more: Any) -> str:
    job = server.client.batch("SubmitJob", jobName=name, jobQueue="default", jobDefinition=name, **more)
    return str(job["jobId"])


def kept(server: Serving) -> dict[str, Path]:
    """The files of the uploads, by name."""
    return {path.name: path for path in server.home.glob("store/texts/*/*")}


def test_a_definition_is_registered_once_its_text_is_uploaded_and_the_run_has_a_copy(server: Serving) -> None:
    text = "a long text\n"
    lacks = refused(server, "RegisterJobDefinition", **definition("reads", text))
    assert lacks == (
        f"train.config.reward_function: mine.py (sha256 {digest_of(text)}): the store keeps no such text; "
        f"submit the job with the file itself, or upload it first: PUT /api/texts/{digest_of(text)}"
    )
    server.client.keep_text(text)
    server.client.batch("RegisterJobDefinition", **definition("reads", text))
    job = submitted(server, "reads")
    run = server.wait(job, "SUCCEEDED")["run"]
    assert server.log(job)[0] == "text True"
    assert httpx.get(f"{server.url}/api/runs/{run}/texts/{digest_of(text)}").text == text
    assert server.client.run_text(run, digest_of(text)) == text
    assert httpx.get(f"{server.url}/api/runs/{run}/texts/{'0' * 64}").status_code == 404
    assert server.client.run_text(run, "0" * 64) is None
    kept(server)[digest_of(text)].unlink()
    assert "the store keeps no such text" in refused(
        server, "SubmitJob", jobName="again", jobQueue="default", jobDefinition="reads"
    )
    assert httpx.get(f"{server.url}/api/runs/{run}/texts/{digest_of(text)}").text == text


@pytest.mark.parametrize("is_altered", [False, True])
def test_a_text_that_is_lost_while_its_job_waits_ends_the_job_with_one_line(server: Serving, is_altered: bool) -> None:
    text, gate = f"lost {is_altered}\n", server.home / f"gate-{is_altered}"
    first = server.gang(f"import pathlib, time\nwhile not pathlib.Path({str(gate)!r}).exists(): time.sleep(0.05)")
    server.client.keep_text(text)
    server.client.batch("RegisterJobDefinition", **definition("waits", text))
    job = submitted(server, "waits", dependsOn=[{"jobId": first}])
    path = kept(server)[digest_of(text)]
    if is_altered:
        path.write_text(text.upper())
    else:
        path.unlink()
    gate.touch()
    ended = server.wait(job, "FAILED")
    why = "altered: its content has another digest" if is_altered else "missing"
    assert (
        f"mine.py (sha256 {digest_of(text)}): the text kept at {path} is {why}; submit the job again"
        in (ended["statusReason"])
    )
    assert "\n" not in ended["statusReason"] and not (server.home / "store" / "runs" / ended["run"]).exists()


def test_an_upload_that_breaks_off_or_has_another_digest_keeps_nothing(server: Serving) -> None:
    text, before = "half of it is sent\n" * 1000, set(kept(server))
    address = urlsplit(server.url)
    with socket.create_connection((str(address.hostname), int(address.port or 0))) as connection:
        head = f"PUT /api/texts/{digest_of(text)} HTTP/1.1\r\nHost: {address.netloc}\r\nContent-Length: {len(text)}\r\n\r\n"
        connection.sendall(head.encode() + text[: len(text) // 2].encode())
    wrong = httpx.put(f"{server.url}/api/texts/{digest_of(text)}", content=text[:-1])
    found = digest_of(text[:-1])
    reported = f"the text that came has sha256 {found}, not {digest_of(text)}; send it again"
    assert (wrong.status_code, wrong.json()["message"]) == (400, reported)
    binary = httpx.put(f"{server.url}/api/texts/{'0' * 64}", content=b"\xff")
    assert (binary.status_code, binary.json()["message"]) == (400, "the body is not a text (UTF-8)")
    large = httpx.put(f"{server.url}/api/texts/{'0' * 64}", content=b"x" * ((1 << 20) + 1))
    assert large.status_code == 413
    assert set(kept(server)) == before
