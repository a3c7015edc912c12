"""The command as a person types it: bad input ends with one clear line and an exit code, and leaves nothing half made."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest
from rich.table import Table

from orchestrator.cli.jobs import _gpus
from orchestrator.cli.terminal import print_cut
from tests.conftest import MUSTER, PATIENCE, REPOSITORY, Serving, call_muster, wait_for

REQUIREMENTS = [{"type": "VCPU", "value": "0.1"}, {"type": "MEMORY", "value": "16"}]


def refused(arguments: list[str], home: Path, code: int, *parts: str, **env: str) -> None:
    """The command exits with ``code`` and one line on stderr that holds all ``parts``."""
    done = call_muster(*arguments, home=home, **env)
    assert done.returncode == code, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1 and "Traceback" not in done.stderr, done.stderr
    for part in parts:
        assert part in lines[0], f"{part!r} is not in: {lines[0]}"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("- a\n- list\n", ["expected a mapping", "found a list"]),
        ("name: [unclosed\n", ["not valid YAML"]),
        ("", ["expected a mapping", "found nothing"]),
        ("name: a\ntrain: {task: Cartpol, worlds: 4, iterations: 1}\n", [":2: train.task", "did you mean Cartpole?"]),
        ("name: a\nnodes: 0\ncommand: [x]\n", [":2: nodes", "greater than or equal to 1", "found 0"]),
        ("name: a\nnodes: two\ncommand: [x]\n", [":2: nodes", "whole number of nodes"]),
        ("name: a\nnode: 2\ncommand: [x]\n", [":2: node: unknown key; did you mean nodes?"]),
        (
            "name: a\ncommand: [x]\ntrain: {task: Ant, worlds: 1, iterations: 1}\n",
            ["exactly one of", "found train and command"],
        ),
        ("name: a\nresources: {memory: lots}\ncommand: [x]\n", [":2: resources.memory", "such as 512MiB or 4GiB"]),
    ],
)
def test_a_bad_spec_is_refused_with_file_line_and_key(tmp_path: Path, text: str, parts: list[str]) -> None:
    spec = tmp_path / "job.yaml"
    spec.write_text(text)
    home = tmp_path / "home"
    refused(["run", str(spec)], home, 2, str(spec), *parts)
    assert not home.exists(), "a refused spec must not start a controller"


def test_a_missing_file_and_a_bad_override_are_named(tmp_path: Path) -> None:
    refused(["submit", "nowhere.yaml"], tmp_path, 2, "nowhere.yaml: No such file")
    spec = "job_specs/cartpole.yaml"
    refused(
        ["submit", spec, "--set", "train.iteration=5"],
        tmp_path,
        2,
        "train.iteration: unknown key; did you mean iterations?",
    )
    refused(["submit", spec, "--set", "novalue"], tmp_path, 2, "--set novalue: expected KEY=VALUE")


def test_more_than_any_host_has_is_refused_before_anything_is_registered(shared_server: Serving) -> None:
    before = shared_server.client.batch(
        "ListJobs", jobQueue="default", filters=[{"name": "AFTER_CREATED_AT", "values": ["0"]}]
    )
    for change, parts in [
        ("resources.gpus=99", ["99 GPUs", "the largest host has", "gpus=0 and train.worlds=16 try it on CPUs"]),
        ("resources.cpus=512", ["512 CPUs", "the largest host has 8 CPUs"]),
        ("nodes=200", ["needs 200 nodes", "all hosts together have"]),
    ]:
        refused(
            ["submit", "job_specs/cartpole.yaml", "--set", change],
            shared_server.home,
            2,
            "cartpole.yaml: resources:",
            *parts,
        )
    after = shared_server.client.batch(
        "ListJobs", jobQueue="default", filters=[{"name": "AFTER_CREATED_AT", "values": ["0"]}]
    )
    assert before == after


def test_a_store_that_is_not_writable_is_refused(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a directory")
    refused(
        ["serve", "--port", "0", "--store", str(blocked / "store")], tmp_path / "home", 1, "not writable", "--store"
    )
    assert not (tmp_path / "home" / "muster.db").exists()
    refused(
        ["run", "job_specs/cartpole.yaml", "--store", "/proc/store"],
        tmp_path / "home",
        1,
        "store /proc/store: not writable",
    )


def test_a_port_in_use_is_refused(tmp_path: Path) -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = str(holder.getsockname()[1])
        refused(["serve", "--port", port], tmp_path, 1, f"can't listen on 127.0.0.1:{port}", "--port")


def test_a_second_controller_on_the_same_home_is_refused(shared_server: Serving) -> None:
    refused(["serve", "--port", "0"], shared_server.home, 1, "already served by a controller (pid ", shared_server.url)


def test_off_loopback_a_token_is_demanded_and_then_checked(tmp_path: Path) -> None:
    refused(["serve", "--host", "0.0.0.0", "--port", "0"], tmp_path, 1, "set MUSTER_TOKEN")
    os.environ["MUSTER_TOKEN"] = "a-secret-of-this-test"
    try:
        server = Serving(tmp_path / "home", "--host", "0.0.0.0")
    finally:
        del os.environ["MUSTER_TOKEN"]
    try:
        refused(["list"], server.home, 1, "this token is not known here", MUSTER_TOKEN="wrong")
        refused(["list"], server.home, 1, "a token is needed")
        assert call_muster("list", home=server.home, MUSTER_TOKEN="a-secret-of-this-test").returncode == 0
    finally:
        server.close()


def test_commands_without_a_controller_say_how_to_start_one(tmp_path: Path) -> None:
    with socket.socket() as holder:  # a port that nobody serves
        holder.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{holder.getsockname()[1]}"
        refused(["list"], tmp_path, 1, f"no controller answers at {url}", "muster serve", MUSTER_URL=url)


def test_a_home_without_a_controller_does_not_take_anothers(tmp_path: Path) -> None:
    empty = tmp_path / "another-home"
    for command in (["list"], ["show", "x"], ["resume", "x"], ["submit", "job_specs/cartpole.yaml"]):
        refused(command, empty, 1, f"no controller of {empty} runs", "muster serve", "MUSTER_URL")


@pytest.mark.parametrize("url", ["127.0.0.1:8080", "localhost:8080", "http://127.0.0.1:80800", "http://", "ftp://x"])
def test_an_address_that_is_no_url_is_wrong_use(tmp_path: Path, url: str) -> None:
    refused(["list"], tmp_path, 2, f"'{url}' is not the URL of a controller", "http://127.0.0.1:8080", MUSTER_URL=url)


@pytest.mark.parametrize(
    ("option", "part"),
    [(["--engine", "rya"], "there is no such engine; did you mean ray?"), (["--trust-proxy", "x"], "give the proxy's")],
)
def test_an_option_that_serve_cannot_use_is_wrong_use(tmp_path: Path, option: list[str], part: str) -> None:
    refused(["serve", "--port", "0", *option], tmp_path, 2, option[0], part)


def test_an_engine_that_does_not_exist_is_not_recommended(shared_server: Serving) -> None:
    refused(
        ["submit", "job_specs/cartpole.yaml", "--engine", "rya"],
        shared_server.home,
        2,
        "--engine rya: there is no such engine; did you mean ray?",
    )


def test_the_api_s_page_lists_its_operations_and_their_inputs(shared_server: Serving) -> None:
    answer = httpx.get(f"{shared_server.url}/api/docs", trust_env=False)
    assert answer.status_code == 200
    assert "<h2>POST /api/runs/{name}/resume</h2>" in answer.text
    assert "<code>checkpoint</code></td><td>integer or null" in answer.text


def test_the_api_s_page_needs_no_script_and_nothing_from_elsewhere(shared_server: Serving) -> None:
    answer = httpx.get(f"{shared_server.url}/api/docs", trust_env=False)
    assert re.findall(r"<script|src=|@import|url\(|://|\son\w+=", answer.text) == []
    assert re.findall(r'href="(.*?)"', answer.text) == ["/api/openapi.json"]
    (style,) = re.findall(r"<style>(.*?)</style>", answer.text, re.S)
    allowed = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert f"default-src 'none'; style-src 'sha256-{allowed}';" in answer.headers["content-security-policy"]


@pytest.mark.parametrize(
    ("path", "status"), [("/healthz", 200), ("/api/docs", 200), ("/api/jobs/none", 404), ("/nowhere", 404), ("/", 403)]
)
def test_no_answer_may_be_framed_or_taken_for_another_type(shared_server: Serving, path: str, status: int) -> None:
    headers = {"Origin": "http://evil.example"} if status == 403 else {}
    answer = httpx.get(f"{shared_server.url}{path}", headers=headers, trust_env=False)
    assert answer.status_code == status
    assert answer.headers["x-frame-options"] == "DENY" and answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "same-origin"
    assert all("frame-ancestors 'none'" in policy for policy in answer.headers.get_list("content-security-policy"))


def test_unknown_jobs_and_runs_are_named(shared_server: Serving) -> None:
    home = shared_server.home
    refused(["show", "nonsense"], home, 2, "job nonsense does not exist")
    refused(["logs", "nonsense"], home, 2, "job nonsense does not exist")
    refused(["stop", "nonsense"], home, 2, "job nonsense does not exist")
    refused(["resume", "nonsense"], home, 2, "run nonsense does not exist")
    refused(["checkpoints", "nonsense"], home, 2, "run nonsense does not exist")
    for name in ("../../etc", "a/b", "..", "a b"):
        refused(["checkpoints", name], home, 2, f"{name!r} names nothing; jobs and runs are named with letters")
        refused(["show", name], home, 2, f"{name!r} names nothing")


def test_a_run_that_no_spec_started_is_not_resumed_blindly(shared_server: Serving) -> None:
    job = shared_server.gang("pass", name="plain")
    detail = shared_server.wait(job)
    refused(["resume", detail["run"]], shared_server.home, 2, "was not started from a YAML spec")


def test_help_has_examples_for_every_command(tmp_path: Path) -> None:
    listing = call_muster("--help", home=tmp_path).stdout
    for command in (
        "run",
        "serve",
        "submit",
        "list",
        "show",
        "stop",
        "schema",
        "logs",
        "resume",
        "clone",
        "checkpoints",
    ):
        assert f" {command} " in listing
        assert "Example" in call_muster(command, "--help", home=tmp_path).stdout or command == "schema"


def test_submit_list_show_logs_and_stop_work_from_another_terminal(shared_server: Serving, tmp_path: Path) -> None:
    spec = tmp_path / "job.yaml"
    spec.write_text(
        "name: greeter\nnodes: 2\nresources: {cpus: 0.1, memory: 16MiB}\n"
        'command: [python, -u, -c, \'import os, time; print("hello from", os.environ["RANK"]); time.sleep(60)\']\n'
    )
    submitted = json.loads(shared_server.muster("submit", str(spec), "--json").stdout)
    shared_server.wait(submitted["jobId"], "RUNNING")
    wait_for(lambda: len(shared_server.log(submitted["jobId"])) == 2, what="both greetings")
    assert "greeter" in shared_server.muster("list").stdout
    shown = shared_server.muster("show", "greeter").stdout
    assert "RUNNING" in shown and "node 1" in shown and "attempt 1 of 3" in shown
    assert "hello from 1" in shared_server.muster("logs", "greeter", "--node", "1").stdout
    only = shared_server.muster(
        "logs", submitted["jobId"][:8], "--rank", "0", "--since", "10m", "--grep", "hello"
    ).stdout
    assert "hello from 0" in only and "hello from 1" not in only
    stopped = shared_server.muster("stop", "greeter")
    assert stopped.returncode == 0 and "ended: stopped by the user" in stopped.stdout
    run = shared_server.detail(submitted["jobId"])["run"]
    assert f"continue with: muster resume {run}\n" in stopped.stdout
    refused(["resume", "greeter"], shared_server.home, 2, f"greeter is a job, not a run; its run is {run}")
    assert json.loads(shared_server.muster("show", "greeter", "--json").stdout)["status"] == "FAILED"
    assert "FAILED already" in shared_server.muster("stop", "greeter").stdout


def test_a_narrow_terminal_cuts_reasons_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("NO_COLOR", "1")
    table = Table(box=None, pad_edge=False)
    for column in ("JOB", "NAME", "STATUS", "REASON"):
        table.add_column(column, no_wrap=True, overflow="ellipsis" if column == "REASON" else "fold")
    table.add_row("0123abcd", "a-job-of-that-name", "[red]FAILED[/]", "node 2: " + "a long story " * 20)
    table.add_row("4567abcd", "another", "RUNNABLE", "waits")
    print_cut(table)
    _, first, second = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert first[:3] == ["0123abcd", "a-job-of-that-name", "FAILED"] and first[-1].endswith("…")
    assert second == ["4567abcd", "another", "RUNNABLE", "waits"]


def test_for_another_program_long_reasons_are_whole_and_no_column_is_lost(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table(box=None, pad_edge=False)
    for column in ("JOB", "NAME", "REASON"):
        table.add_column(column, no_wrap=True, overflow="ellipsis" if column == "REASON" else "fold")
    table.add_row("0123abcd", "a-job", "a long story " * 120)
    print_cut(table)
    header, row = capsys.readouterr().out.splitlines()
    assert header == header.rstrip(), "a long row pads no other"
    assert header.split() == ["JOB", "NAME", "REASON"] and row.split()[:2] == ["0123abcd", "a-job"]
    assert row.count("story") == 120


def test_an_error_in_set_names_no_line_of_the_file(tmp_path: Path) -> None:
    wrong = ["submit", "job_specs/cartpole.yaml", "--dry-run", "--set", "train.task=Cartpol"]
    refused(wrong, tmp_path, 2, "muster: --set: train.task: no task is called 'Cartpol'")


def test_an_empty_selection_of_a_log_says_so(shared_server: Serving) -> None:
    job = shared_server.gang("print('here')", name="brief")
    shared_server.wait(job)
    for option, part in ((["--attempt", "9"], "attempt 9"), (["--rank", "77"], "rank 77")):
        done = shared_server.muster("logs", "brief", *option)
        assert done.stdout == "" and f"job brief has no log lines of {part}; muster show brief" in done.stderr


def test_a_log_whose_reader_has_had_enough_ends_in_order(shared_server: Serving) -> None:
    job = shared_server.gang("print('line\\n' * 50_000)", name="long")
    shared_server.wait(job)
    piped = ["bash", "-c", f"{MUSTER} logs long | head -1; exit ${{PIPESTATUS[0]}}"]
    env = {**os.environ, "MUSTER_HOME": str(shared_server.home)}
    done = subprocess.run(piped, env=env, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.endswith("line\n"), done


def test_a_plan_of_a_missing_run_is_refused_as_its_submission_is(shared_server: Serving, tmp_path: Path) -> None:
    spec = tmp_path / "job.yaml"
    spec.write_text("name: judge\nevaluate: {run: nosuch}\n")
    for option in ([], ["--dry-run"]):
        refused(["submit", str(spec), *option], shared_server.home, 2, "run nosuch does not exist")


def test_show_counts_the_children_of_an_array_and_shows_one_by_its_index(shared_server: Serving) -> None:
    container = {"image": "any", "command": ["true"], "resourceRequirements": REQUIREMENTS}
    client = shared_server.client
    client.batch("RegisterJobDefinition", jobDefinitionName="many", type="container", containerProperties=container)
    array = client.batch(
        "SubmitJob", jobName="many", jobQueue="default", jobDefinition="many", arrayProperties={"size": 3}
    )["jobId"]
    shared_server.wait(array)
    shown = shared_server.muster("show", "many").stdout
    assert f"children:     3: 3 SUCCEEDED; muster show {array[:8]}:0" in shown and "run:" not in shown
    for reference in ("many:2", f"{array[:8]}:2", f"{array}:2"):
        assert f"{array}:2" in shared_server.muster("show", reference).stdout
    for missing in ("many:3", "many:x", "nosuch:0", f"{array[:8]}:1:1"):
        refused(["show", missing], shared_server.home, 2, f"job {missing} does not exist")


def test_the_all_reduce_example_needs_no_muster_import(shared_server: Serving) -> None:
    assert "muster" not in (REPOSITORY / "job_specs" / "all_reduce.py").read_text().lower()
    done = shared_server.muster("run", "job_specs/all-reduce.yaml")
    assert done.returncode == 0, done.stdout + done.stderr
    for rank in range(3):
        assert f"rank {rank} of 3 on node {rank}: sum = 6, expected 6" in done.stdout


def test_ctrl_c_while_the_job_waits_ends_it_as_one_that_never_started(server: Serving) -> None:
    full = server.gang("import time; time.sleep(600)", cpus="4")
    server.wait(full, "RUNNING")
    running = subprocess.Popen(
        [MUSTER, "run", "job_specs/cartpole.yaml"],
        env={**os.environ, "MUSTER_HOME": str(server.home)},
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert running.stdout is not None
    wait_for(lambda: "RUNNABLE" in running.stdout.readline(), 30, "the job waits")
    running.send_signal(signal.SIGTERM)  # is taken as Ctrl-C is
    said, errors = running.communicate(timeout=60 * PATIENCE)
    assert (running.returncode, errors) == (130, ""), said
    assert "FAILED  cartpole (" in said and ": stopped with Ctrl-C" in said
    [job] = [each for each in json.loads(server.muster("list", "--json").stdout) if each["jobName"] == "cartpole"]
    never = f"job cartpole ({job['jobId'][:8]}) never started; submit it again"
    refused(["resume", server.detail(job["jobId"])["run"]], server.home, 2, never)


@pytest.mark.parametrize(
    ("node", "said"),
    [
        ({"host": "localhost", "gpus": ["2", "3"]}, ", GPUs 2,3"),
        ({"host": "ray/n1", "gpus": ["0", "1"]}, ", 2 GPUs"),
        ({"host": "ray/n1", "gpus": ["0"], "devices": ["5"]}, ", GPUs 5"),
        ({"host": "slurm/n1", "gpus": ["0"]}, ", 1 GPU"),
        ({"host": "ray/n1", "gpus": []}, ""),
    ],
)
def test_show_names_gpus_only_where_it_is_known_which_they_are(node: dict[str, Any], said: str) -> None:
    assert _gpus(node) == said
