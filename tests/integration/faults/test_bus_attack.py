"""The bus against a hostile node: it has a credential of its own, knows every other job's id, and speaks Zenoh as it likes."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from orchestrator.control.bus import Bus, BusError
from shared_store.contract.bus import Credential, Node, log_command, presence_key, push_proof
from tests.conftest import Serving, wait_for
from tests.support.worker.node import node_contract
from worker.node.bus import NodeBus

KEY = "muster/victim/1/0"
VICTIM = ("victim", 1, 0)


class Victim:
    """A node that answers each command with its name, and counts them."""

    def __init__(self, bus: Bus) -> None:
        _read, write = os.pipe2(os.O_NONBLOCK)
        self.node = NodeBus(node_contract(bus.endpoint, bus.token("victim", 1), job="victim"), write)
        self.node.tend({"iteration": 7})
        self.done: list[str] = []
        self._answering = threading.Thread(target=self._answer, daemon=True)
        self._answering.start()

    def _answer(self) -> None:
        while True:
            command = self.node.commands.get()
            self.done.append(command.name)
            command.reply(f"{command.name} done")

    def report(self, bus: Bus, progress: dict[str, int]) -> None:
        """Until it has arrived: under load a report may be dropped, and a node sends its newest one every second."""

        def arrived() -> bool:
            self.node._next_progress = 0.0
            self.node.tend(progress)
            return bus.progress("victim", 1, 0) == progress

        wait_for(arrived, 10, "the victim's progress")


@pytest.fixture(scope="module")
def bus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bus]:
    bus = Bus(tmp_path_factory.mktemp("home"), {})
    bus.open()
    bus.expect("victim", 1, nodes=2)
    bus.expect("mallory", 1, nodes=2)
    yield bus
    bus.close()


@pytest.fixture
def victim(bus: Bus) -> Iterator[Victim]:
    victim = Victim(bus)
    victim.report(bus, {"iteration": 7})
    wait_for(lambda: bus.presence.silence(VICTIM, None) is None and bus.presence.met(VICTIM), 10, "the victim's token")
    yield victim
    victim.node.close()


@pytest.fixture(params=["client", "peer", "router"])
def mallory(bus: Bus, request: pytest.FixtureRequest) -> Iterator[zenoh.Session]:
    session = attacker(bus, request.param)
    yield session
    session.close()


def attacker(bus: Bus, mode: str = "client") -> zenoh.Session:
    """A session with the credential of attempt 1 of job mallory."""
    config = zenoh.Config()
    settings = {
        "mode": mode,
        "connect/endpoints": [bus.endpoint],
        "scouting/multicast/enabled": False,
        "transport/auth/usrpwd/user": "muster",
        "transport/auth/usrpwd/password": own(bus).password,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def put(session: zenoh.Session, key: str, text: str, proof: bytes | None) -> None:
    """Publish; under load Zenoh would drop it by default."""
    session.put(key, text, attachment=proof, congestion_control=zenoh.CongestionControl.BLOCK)


def own(bus: Bus) -> Credential:
    return Credential.parse(bus.token("mallory", 1) or "")


def settled(bus: Bus, session: zenoh.Session | None = None) -> None:
    """Returns when the controller has read what the session sent before: its own progress comes after that.

    Without a session, where it was sent by one in the mode of a router, which does not learn that the controller reads progress.
    """
    if session is None:
        time.sleep(0.3)
        with attacker(bus) as session:
            settled(bus, session)
        return
    key, text = "muster/mallory/1/0/progress", json.dumps({"mark": os.urandom(4).hex()})
    put(session, key, text, own(bus).prove("progress", key, text))
    wait_for(lambda: bus.progress("mallory", 1, 0) == json.loads(text), 10, "the attacker's own progress")


def test_a_node_commands_no_other_not_even_with_its_own_proof(bus: Bus, victim: Victim, mallory: zenoh.Session) -> None:
    proof = own(bus).prove("command", f"{KEY}/command/stop", "1")
    payload = json.dumps({"id": "1", "proof": proof})
    for key in (f"{KEY}/command/stop", "muster/*/*/*/command/stop", "muster/**"):
        replies = list(mallory.get(key, payload=payload, target=zenoh.QueryTarget.ALL, timeout=0.5))
        # where the machine is busy, its own session says that the time is over: nobody's answer
        assert [each for each in replies if each.err is None or bytes(each.err.payload) != b"Timeout"] == []
    assert bus.command("victim", 1, 0, "stacks", 10) == "stacks done"
    assert victim.done == ["stacks"]


def test_a_node_neither_reads_nor_lists_what_others_say(bus: Bus, victim: Victim, mallory: zenoh.Session) -> None:
    seen: list[str] = []
    note = zenoh.handlers.Callback(lambda sample: seen.append(str(sample.key_expr)), indirect=False)
    held = [mallory.declare_subscriber(key, note) for key in (f"{KEY}/progress", "muster/*/*/*/progress", "**")]
    present = mallory.liveliness().declare_subscriber("muster/**", note, history=True)
    assert list(mallory.liveliness().get("muster/**", timeout=0.5)) == []
    victim.report(bus, {"iteration": 8})
    assert bus.command("victim", 1, 0, "stacks", 10) == "stacks done"
    settled(bus)
    assert [key for key in seen if "victim" in key] == []
    assert len(held) == 3 and present is not None


def test_a_node_publishes_below_its_own_key_only(bus: Bus, victim: Victim, mallory: zenoh.Session) -> None:
    lie = json.dumps({"iteration": 999})
    for key in (
        f"{KEY}/progress",
        "muster/*/*/*/progress",
        "muster/victim/1/*/progress",
        "muster/victim/0x1/0/progress",
    ):
        put(mallory, key, lie, own(bus).prove("progress", key, lie))
        put(mallory, key, lie, b"\xff")
        put(mallory, key, lie, None)
        mallory.delete(key)
    settled(bus)
    assert bus.progress("victim", 1, 0) == {"iteration": 7}


def test_a_node_feigns_no_presence_nor_absence_of_another(bus: Bus, victim: Victim, mallory: zenoh.Session) -> None:
    keys = [presence_key(own(bus), "victim", 1, node) for node in (0, 1)]
    keys += [f"{KEY}/alive/é", "muster/*/*/*/alive/*"]
    tokens = [mallory.liveliness().declare_token(key) for key in keys]
    settled(bus)
    assert not bus.presence.met(("victim", 1, 1))
    for token in tokens:
        token.undeclare()
    settled(bus)
    assert bus.presence.silence(VICTIM, None) is None


@pytest.mark.parametrize("complete", [False, True])
def test_an_answer_in_another_s_name_is_ignored(
    bus: Bus, victim: Victim, mallory: zenoh.Session, complete: bool
) -> None:
    overheard: list[dict[str, Any]] = []

    def forge(query: Any) -> None:
        request = json.loads(query.payload.to_bytes())
        overheard.append(request)
        key = str(query.key_expr)
        proof = own(bus).prove("answer", key, request["id"], "forged")
        for answer in ({"text": "forged", "proof": proof}, {"text": "forged", "proof": request["proof"]}, [], "forged"):
            query.reply(key, json.dumps(answer))
        query.drop()

    forger = zenoh.handlers.Callback(forge, indirect=False)
    keys = (f"{KEY}/command/checkpoint", "muster/*/*/*/command/*")
    held = [mallory.declare_queryable(key, forger, complete=complete) for key in keys]
    wait_for(lambda: bus.command("victim", 1, 0, "checkpoint", 10) == "checkpoint done" and overheard, 20, "the forger")
    with pytest.raises(BusError, match="node 1 did not answer"):
        bus.command("victim", 1, 1, "checkpoint", 1)
    # all that it overheard is worth nothing: a number that was used, and a proof for this key alone
    assert overheard[0].keys() == {"id", "proof"} and len(held) == 2


def test_a_node_pushes_into_no_other_s_log_and_makes_none_push(
    bus: Bus, victim: Victim, mallory: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    pushed: list[tuple[Node, int, bytes]] = []
    monkeypatch.setattr(bus, "is_followed", lambda _: True)
    monkeypatch.setattr(bus, "pushed", lambda *values: pushed.append(values))
    lie, mine = b"2026-01-01T00:00:00.000000Z 0 o forged\n", "muster/mallory/1/0/log"
    for key in (f"{KEY}/log", "muster/*/*/*/log", "muster/victim/1/*/log"):
        proof = push_proof(own(bus), key, 0, lie)
        for attachment in (
            f"{proof} 0",
            f"{push_proof(own(bus), mine, 0, lie)} 0",
            proof,
            f"{proof} -1",
            b"\xff 0",
            None,
        ):
            mallory.put(key, lie, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)
    number = "1"
    for key in (log_command("victim", 1), "muster/**"):
        request = json.dumps({"id": number, "proof": own(bus).prove("command", key, number)})
        list(mallory.get(key, payload=request, target=zenoh.QueryTarget.ALL, timeout=0.5))
    settled(bus)
    assert pushed == [] and not victim.node.is_followed
    bus.ask_for_logs("victim", 1)
    wait_for(lambda: victim.node.is_followed, 10, "the command")
    victim.node.push_log(7, b"")  # counts for nothing: it would cost a place in memory
    victim.node.push_log(7, b"true\n")
    wait_for(lambda: pushed == [(VICTIM, 7, b"true\n")], 10, "the victim's own line")


def test_a_command_that_is_repeated_is_not_carried_out_again(bus: Bus, victim: Victim) -> None:
    credential = Credential.parse(bus.token("victim", 1) or "")
    key = f"{KEY}/command/stop"
    payload = json.dumps({"id": "once", "proof": credential.prove("command", key, "once")})
    keys = (key, key, f"{KEY}/command/stacks")
    answers = [list(bus._session.get(each, payload=payload, timeout=1.0)) for each in keys]
    assert [len(each) for each in answers] == [1, 0, 0]
    assert victim.done == ["stop"]


def test_invented_keys_leave_nothing_in_the_controller(bus: Bus, victim: Victim) -> None:
    session = attacker(bus)
    before = set(bus.presence._nodes), set(bus._progress) | {("mallory", 1, 0)}
    tokens = []
    for number in range(20_000):
        key = f"muster/invented-{number}/1/0/progress"
        put(session, key, "{}", own(bus).prove("progress", key, "{}"))
        own_key = f"muster/mallory/1/{number + 2}/progress"  # of nodes that the attempt does not have
        put(session, own_key, "{}", own(bus).prove("progress", own_key, "{}"))
        if number % 100 == 0:
            tokens.append(session.liveliness().declare_token(presence_key(own(bus), "mallory", 1, number + 2)))
            tokens.append(session.liveliness().declare_token(presence_key(own(bus), f"invented-{number}", 1, 0)))
    settled(bus, session)
    assert (set(bus.presence._nodes), set(bus._progress)) == before
    session.close()


def test_messages_of_a_closed_attempt_are_dropped(tmp_path: Path) -> None:
    bus = Bus(tmp_path, {})
    bus.open()
    try:
        bus.expect("victim", 1, nodes=2)
        bus.expect("mallory", 1, nodes=2)
        victim, session = Victim(bus), attacker(bus)
        victim.report(bus, {"iteration": 7})
        bus.forget("victim", 1)
        victim.node._next_progress = 0.0
        victim.node.tend({"iteration": 8})
        victim.node.close()
        settled(bus, session)
        assert {job for job, _, _ in (*bus.presence._nodes, *bus._progress)} == {"mallory"}
        session.close()
    finally:
        bus.close()


def test_reports_that_are_too_large_too_deep_or_no_object_are_dropped(bus: Bus) -> None:
    session, key = attacker(bus), "muster/mallory/1/0/progress"
    settled(bus, session)
    before = bus.progress("mallory", 1, 0)
    for text in ("[1]", "1", "null", '{"reward": 1e999}', '"x"', "{", "[" * 60_000, json.dumps({"fill": "x" * 70_000})):
        put(session, key, text, own(bus).prove("progress", key, text))
    victim_key = "muster/mallory/1/1/progress"
    put(session, victim_key, "{}", own(bus).prove("progress", victim_key, "{}"))
    text = json.dumps({"last": True})
    put(session, victim_key, text, own(bus).prove("progress", victim_key, text))
    wait_for(lambda: bus.progress("mallory", 1, 1) == {"last": True}, 10, "the last report")
    assert bus.progress("mallory", 1, 0) == before
    session.close()


STOP_ANOTHER = """
import json, os, time, zenoh
from pathlib import Path
assert not [name for name in os.environ if name.startswith("MUSTER_BUS")], "the bus is the supervisor's"
environment = dict(item.split("=", 1) for item in Path(f"/proc/{os.getppid()}/environ").read_text().split("\\0") if item)
config = zenoh.Config()
for key, value in {"mode": "client", "connect/endpoints": [environment["MUSTER_BUS"]], "scouting/multicast/enabled": False,
    "transport/auth/usrpwd/user": "muster", "transport/auth/usrpwd/password": environment["MUSTER_BUS_TOKEN"].split(".")[0]}.items():
    config.insert_json5(key, json.dumps(value))
session = zenoh.open(config)
print(f"tokens: {len(list(session.liveliness().get('muster/*/*/*/alive/*', timeout=2)))}")
print(f"answers: {len(list(session.get('muster/VICTIM/1/0/command/stop', timeout=2)))}")
"""


def test_a_job_that_takes_its_supervisors_credential_stops_no_other_job(shared_server: Serving) -> None:
    server = shared_server
    victim = server.gang("import time; time.sleep(600)")
    wait_for(lambda: server.muster("stacks", victim).returncode == 0, 30, "the victim on the bus")
    hostile = server.gang(STOP_ANOTHER.replace("VICTIM", victim))
    assert server.wait(hostile)["status"] == "SUCCEEDED"
    assert server.log(hostile)[:2] == ["tokens: 0", "answers: 0"]
    assert server.detail(victim)["status"] == "RUNNING"
    assert server.muster("stacks", victim).returncode == 0
    assert server.muster("stop", victim).returncode == 0
