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

from orchestrator.cli.terminal import print_cut
from tests.conftest import MUSTER, PATIENCE, REPOSITORY, Serving, call_muster, wait_for
from tests.support.orchestrator.jobs import FOREVER, refusal, refused

SPEC = "job_specs/cartpole.yaml"


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (["run", "{spec}"], "{spec}:2: nodes: expected an integer number of nodes"),
        (["submit", "nowhere.yaml"], "nowhere.yaml: No such file"),
        (["submit", SPEC, "--set", "novalue"], "--set novalue: expected KEY=VALUE"),
        (["submit", SPEC, "--set", "train.task=Cartpol", "--dry-run"], "muster: --set: train.task: no task is called"),
    ],
)
def test_a_bad_spec_file_or_change_is_refused_before_any_controller(
    tmp_path: Path, arguments: list[str], output: str
) -> None:
    spec, home = tmp_path / "job.yaml", tmp_path / "home"
    spec.write_text("name: a\nnodes: two\ncommand: [x]\n")
    refused([each.format(spec=spec) for each in arguments], home, 2, output.format(spec=spec))
    assert not home.exists()


def test_more_than_any_host_has_is_refused_before_anything_is_registered(shared_server: Serving) -> None:
    for change, parts in [
        ("resources.gpus=99", ["99 GPUs", "the largest host has", "gpus=0 and train.worlds=16 try it on CPUs"]),
        ("resources.cpus=512", ["512 CPUs", "the largest host has 8 CPUs"]),
        ("nodes=200", ["needs 200 nodes", "all hosts together have"]),
    ]:
        output = refusal(shared_server, "submit", SPEC, "--set", change)
        assert all(part in output for part in ("cartpole.yaml: resources:", *parts)), output
    output = refusal(shared_server, "submit", SPEC, "--engine", "rya")
    assert "--engine rya: unknown engine; did you mean ray?" in output


def test_a_server_that_can_t_start_says_why(shared_server: Serving, tmp_path: Path) -> None:
    home, serve = tmp_path / "home", ["serve", "--port", "0"]
    refused(serve, shared_server.home, 1, "already served by a controller (pid ", shared_server.url)
    (tmp_path / "file").write_text("not a directory")
    refused([*serve, "--store", str(tmp_path / "file" / "store")], home, 1, "not writable", "--store")
    assert not (home / "muster.db").exists()
    refused(["run", SPEC, "--store", "/proc/store"], home, 1, "store /proc/store: not writable")
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = str(holder.getsockname()[1])
        refused(["serve", "--port", port], home, 1, f"can't listen on 127.0.0.1:{port}", "--port")
    refused([*serve, "--host", "0.0.0.0"], home, 1, "set MUSTER_TOKEN")
    for option, output in (
        (["--engine", "rya"], "unknown engine; did you mean ray?"),
        (["--trust-proxy", "x"], "give the proxy's"),
        (["--min-free", "lots"], "lots: expected a size such as 1GiB, a share such as 5%, or 0"),
    ):
        refused([*serve, *option], home, 2, option[0], output)


def test_commands_without_a_controller_say_how_to_start_one_and_take_no_other(tmp_path: Path) -> None:
    with socket.socket() as holder:  # a port that nobody serves
        holder.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{holder.getsockname()[1]}"
        refused(["list"], tmp_path, 1, f"no controller answers at {url}", "muster serve", MUSTER_URL=url)
    empty = tmp_path / "another-home"
    for command in (["list"], ["show", "x"], ["resume", "x"], ["submit", SPEC]):
        refused(command, empty, 1, f"no controller of {empty} runs", "muster serve", "MUSTER_URL")


@pytest.mark.parametrize("url", ["127.0.0.1:8080", "localhost:8080", "http://127.0.0.1:80800", "http://", "ftp://x"])
def test_an_address_that_is_not_a_url_is_wrong_use(tmp_path: Path, url: str) -> None:
    refused(["list"], tmp_path, 2, f"'{url}' is not the URL of a controller", "http://127.0.0.1:8080", MUSTER_URL=url)


def test_the_api_s_page_lists_operations_and_no_answer_may_be_framed_or_taken_for_another_type(
    shared_server: Serving,
) -> None:
    for path, status in (("/healthz", 200), ("/api/jobs/none", 404), ("/", 403), ("/api/docs", 200)):
        headers = {"Origin": "http://evil.example"} if status == 403 else {}
        answer = httpx.get(f"{shared_server.url}{path}", headers=headers, trust_env=False)
        assert answer.status_code == status and answer.headers["referrer-policy"] == "same-origin"
        assert answer.headers["x-frame-options"] == "DENY" and answer.headers["x-content-type-options"] == "nosniff"
        assert all("frame-ancestors 'none'" in each for each in answer.headers.get_list("content-security-policy"))
    assert "<h2>POST /api/runs/{name}/resume</h2>" in answer.text
    assert "<code>checkpoint</code></td><td>integer or null" in answer.text
    assert re.findall(r"<script|src=|@import|url\(|://|\son\w+=", answer.text) == []
    assert re.findall(r'href="(.*?)"', answer.text) == ["/api/openapi.json"]
    (style,) = re.findall(r"<style>(.*?)</style>", answer.text, re.S)
    allowed = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert f"default-src 'none'; style-src 'sha256-{allowed}';" in answer.headers["content-security-policy"]


def test_unknown_jobs_and_runs_are_named(shared_server: Serving) -> None:
    for kind, commands in (("job", ("show", "logs", "stop")), ("run", ("resume", "checkpoints"))):
        for command in commands:
            refused([command, "nonsense"], shared_server.home, 2, f"{kind} nonsense does not exist")
    for name in ("../../etc", "a/b", "..", "a b"):
        for command, more in (("checkpoints", "; jobs and runs are named with letters"), ("show", "")):
            refused([command, name], shared_server.home, 2, f"{name!r} names nothing{more}")
    detail = shared_server.wait(shared_server.gang("pass", name="plain"))
    refused(["resume", detail["run"]], shared_server.home, 2, "was not started from a YAML spec")
    created = (
        f"{detail['run']} is a run (created by job plain ({detail['id'][:8]})); try: muster show {detail['id'][:8]}"
    )
    refused(["show", detail["run"]], shared_server.home, 2, created)


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
    part = ("--rank", "0", "--since", "10m", "--grep", "hello")
    only = shared_server.muster("logs", submitted["jobId"][:8], *part).stdout
    assert "hello from 0" in only and "hello from 1" not in only
    stopped = shared_server.muster("stop", "greeter")
    assert stopped.returncode == 0 and "ended: stopped by the user" in stopped.stdout
    run = shared_server.detail(submitted["jobId"])["run"]
    assert f"continue with: muster resume {run}\n" in stopped.stdout
    refused(["resume", "greeter"], shared_server.home, 2, f"greeter is a job, not a run; its run is {run}")
    assert json.loads(shared_server.muster("show", "greeter", "--json").stdout)["status"] == "FAILED"
    assert "FAILED already" in shared_server.muster("stop", "greeter").stdout


def test_a_narrow_terminal_cuts_reasons(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_no_table_that_is_read_by_another_program_ends_in_spaces(shared_server: Serving) -> None:
    for command in (["list"], ["queues"], ["queues", "default"], ["models", "list"]):
        done = shared_server.muster(*command)
        assert done.returncode == 0 and not [each for each in done.stdout.splitlines() if each.endswith(" ")], command


def test_an_empty_selection_of_a_log_says_so(shared_server: Serving) -> None:
    job = shared_server.gang("print('here')", name="brief")
    shared_server.wait(job)
    done = shared_server.muster("logs", "brief", "--attempt", "9")
    assert done.stdout == "" and "job brief has no log lines of attempt 9; muster show brief" in done.stderr
    refused(["logs", "brief", "--node", "9"], shared_server.home, 2, "--node 9: job brief has 1 node, numbered from 0")


def test_a_log_whose_reader_has_had_enough_ends_in_order(shared_server: Serving) -> None:
    job = shared_server.gang("print('line\\n' * 50_000)", name="long")
    shared_server.wait(job)
    piped = ["bash", "-c", f"{MUSTER} logs long | head -1; exit ${{PIPESTATUS[0]}}"]
    env = {**os.environ, "MUSTER_HOME": str(shared_server.home)}
    done = subprocess.run(piped, env=env, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.endswith("line\n"), done


def test_the_all_reduce_example_needs_no_muster_import(shared_server: Serving) -> None:
    assert "muster" not in (REPOSITORY / "job_specs" / "all_reduce.py").read_text().lower()
    done = shared_server.muster("run", "job_specs/all-reduce.yaml")
    assert done.returncode == 0, done.stdout + done.stderr
    for rank in range(3):
        assert f"rank {rank} of 3 on node {rank}: sum = 6, expected 6" in done.stdout


def test_ctrl_c_while_the_job_waits_ends_it_as_one_that_never_started(server: Serving) -> None:
    full = server.gang(FOREVER, cpus="4")
    server.wait(full, "RUNNING")
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    env = {**os.environ, "MUSTER_HOME": str(server.home)}
    running = subprocess.Popen([MUSTER, "run", SPEC], env=env, cwd=REPOSITORY, **pipes)
    assert running.stdout is not None
    wait_for(lambda: "RUNNABLE" in running.stdout.readline(), 30, "the job waits")
    running.send_signal(signal.SIGTERM)  # is taken as Ctrl-C is
    output, errors = running.communicate(timeout=60 * PATIENCE)
    stopping = "\nstopping: the job checkpoints and exits (Ctrl-C again: leave it running)\n"
    assert (running.returncode, errors) == (130, stopping), output
    assert "FAILED  cartpole (" in output and ": stopped with Ctrl-C" in output
    [job] = [each for each in json.loads(server.muster("list", "--json").stdout) if each["jobName"] == "cartpole"]
    never = f"job cartpole ({job['jobId'][:8]}) never started; submit it again"
    refused(["resume", server.detail(job["jobId"])["run"]], server.home, 2, never)


def test_who_follows_a_log_is_notified_again_when_the_reason_changes(server: Serving, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    script = f"import os, signal, time\nsignal.signal(15, signal.SIG_IGN)\nwhile not os.path.exists({str(gate)!r}): time.sleep(0.05)"
    server.wait(full := server.gang(script, cpus="4"), "RUNNING")
    waiting = server.gang("print('at last')", cpus="4", name="next")
    wait_for(lambda: "waits for job" in server.detail(waiting)["statusReason"], 30, "its reason")
    command = [MUSTER, "logs", "next", "-f"]
    env = {**os.environ, "MUSTER_HOME": str(server.home)}
    followed = subprocess.Popen(command, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert followed.stderr is not None
    assert f": waits for job test ({full[:8]}) to end: 4 of 4 CPUs short" in followed.stderr.readline()
    server.client.batch("TerminateJob", jobId=full, reason="enough")
    assert f": waits for job test ({full[:8]}) to stop: 4 of 4 CPUs short" in followed.stderr.readline()
    gate.touch()
    assert "at last" in followed.communicate(timeout=60 * PATIENCE)[0] and followed.returncode == 0


RESUMED = """name: twice
resources: {cpus: 0.1, memory: 64MiB}
command: [sh, -c, 'test -e "$GATE" || exit 3; echo through']
environment: {GATE: "%s"}
retry: {attempts: 1}
"""


def test_resume_is_the_controller_itself_where_none_is_running(tmp_path: Path) -> None:
    gate, spec, home = tmp_path / "gate", tmp_path / "job.yaml", tmp_path / "home"
    spec.write_text(RESUMED % gate)
    ran = call_muster("run", str(spec), home=home)
    assert ran.returncode == 1 and "exited with code 3" in ran.stdout, ran.stdout + ran.stderr
    [run] = [each.name for each in (home / "store" / "runs").iterdir()]
    again = call_muster("resume", run, home=home)
    assert again.returncode == 1 and f"resumed {run} as job " in again.stdout and "follow it with" not in again.stdout
    assert "this command is the controller until the job ends" in again.stderr
    gate.touch()
    through = call_muster("resume", run, "--set", "name=thrice", home=home)
    assert through.returncode == 0 and "through" in through.stdout and "SUCCEEDED  thrice (" in through.stdout
    assert not (home / "controller.json").exists() and len(list((home / "store" / "runs").iterdir())) == 1
    refused(["resume", "nosuch"], home, 2, "run nosuch does not exist in")


def test_a_server_and_short_commands_that_start_together_all_succeed(tmp_path: Path) -> None:
    options: dict[str, Any] = {"env": {**os.environ, "MUSTER_HOME": str(tmp_path)}, "stderr": subprocess.PIPE}
    listing = [MUSTER, "models", "list", "--json"]
    for order in ([True, False, False], [False, True, False]):
        started = [
            subprocess.Popen(
                [MUSTER, "serve", "--port", "0"] if serves else listing, text=True, stdout=subprocess.PIPE, **options
            )
            for serves in order
        ]
        server = started[order.index(True)]
        try:
            for command in started:
                if command is not server:
                    output, errors = command.communicate(timeout=60 * PATIENCE)
                    assert command.returncode == 0 and json.loads(output) == [], errors
            assert server.stdout is not None and server.stdout.readline().startswith("Muster serves http")
        finally:
            server.terminate()
        assert server.communicate(timeout=60 * PATIENCE)[1] == "" and server.returncode == 0


# -- muster doctor ----------------------------------------------------------------------------------------------------


def test_all_requirements_are_installed_and_a_controller_is_found(shared_server: Serving, tmp_path: Path) -> None:
    done = call_muster("doctor", "--worker", "--engine", "local", home=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    for output in ("torch 2.", "a durable write takes", "muster serve starts one", "1 host, "):
        assert output in done.stdout
    found = json.loads(shared_server.muster("doctor", "--json").stdout)
    [controller] = [each for each in found if each["what"] == "controller"]
    assert (controller["state"], controller["text"]) == ("ok", f"{shared_server.url}, engines local")


def test_missing_parts_are_reported_with_a_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    bad = call_muster(
        *("doctor", "--store", str(tmp_path / "file" / "store"), "--engine", "docker", "--engine", "nothing"),
        home=tmp_path,
        DOCKER_HOST="unix:///nowhere.sock",
        MUSTER_URL="http://127.0.0.1:9",
    )
    assert bad.returncode == 1 and "Traceback" not in bad.stderr
    lines = [line for line in bad.stdout.splitlines() if line.startswith("BAD")]
    assert len(lines) == 4
    for output in (
        "file/store: Not a directory",
        "set DOCKER_HOST",
        "there is no engine 'nothing'",
        "http://127.0.0.1:9",
    ):
        assert any(output in line for line in lines), output


def test_folders_of_plug_ins_that_are_not_installed_are_named(tmp_path: Path) -> None:
    store = tmp_path / "store"
    (store / "cards").mkdir(parents=True)
    (store / "plugins.json").write_text('{"absent": ["cards"]}')
    found = json.loads(call_muster("doctor", "--json", home=tmp_path).stdout)
    [finding] = [each for each in found if each["what"] == "plug-ins"]
    assert finding["state"] == "absent"
    for part in (
        "plug-in 'absent' is not installed",
        f"folder {store / 'cards'} needs",
        "no run and no job is deleted",
    ):
        assert part in finding["text"]
    (store / "plugins.json").write_text('{"absent": 3}')
    done = call_muster("doctor", home=tmp_path)
    assert done.returncode == 1 and "expected a list of names of folders" in done.stdout


def test_a_resume_without_a_controller_makes_no_store(tmp_path: Path) -> None:
    missing = tmp_path / "stroe"
    done = call_muster("resume", "ant-1f2e3d4c", "--store", str(missing), home=tmp_path / "home")
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert f"--store {missing}: not a store (no store.json)" in done.stderr.replace("\n", " ")
    assert not missing.exists()


def test_a_run_on_a_controller_that_runs_already_says_that_it_ignores_what_to_inherit(server: Serving) -> None:
    spec = server.home / "job.yaml"
    spec.write_text("name: brief\nresources: {cpus: 0.1, memory: 16MiB}\ncommand: ['true']\n")
    done = server.muster("run", str(spec), "--inherit", "WANDB_API_KEY")
    note = f"note: --inherit: the controller at {server.url} runs already; its own --inherit says what jobs get\n"
    assert done.returncode == 0 and note in done.stderr
