"""Speed and jitter of the policy node: ``python -m benchmarks.policy_node``; the tables go to ``policy_node.md``.

The policy is a network of 512, 256 and 128 units with the contract of Go1Flat: 48 observations from a joint state, an IMU, odometry and
a commanded velocity, 12 joint targets. A driver in a separate process sends the four messages and receives the command, over Zenoh.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from benchmarks.load import Watch, add_option, machine, reported
from shared_store.contract.policy import Contract
from shared_store.volume.bundles import seal

REPOSITORY = Path(__file__).parent.parent
REPEATS, SECONDS = 3, 4.0
RATES = (50.0, 500.0)
LAYERS = (512, 256, 128)
ANSWER = "observation in → command out"
GOAL = 2.0
"""99th percentile that is wanted of it [ms]."""
Measured = dict[str, list[tuple[float, float, float]]]
"""By what was measured: median, 99th percentile and maximum of each run [ms]."""
BRIDGE = 16.7
"""Latency of a bridge to ROS 2 in an earlier report on another machine, observation in to command out [ms]."""


def network(inputs: int, outputs: int) -> bytes:
    """A policy with random weights, as ONNX."""
    random, nodes, weights, last = np.random.default_rng(0), [], [], "obs"
    sizes = [inputs, *LAYERS, outputs]
    for layer, (wide, narrow) in enumerate(itertools.pairwise(sizes)):
        name = f"weights_{layer}"
        matrix = random.standard_normal((wide, narrow)) / np.sqrt(wide)
        weights.append(numpy_helper.from_array(matrix.astype(np.float32), name))
        out = "actions" if layer == len(LAYERS) else f"sum_{layer}"
        nodes.append(helper.make_node("MatMul", [last, name], [out]))
        if layer < len(LAYERS):
            last = f"layer_{layer}"
            nodes.append(helper.make_node("Elu", [out], [last]))
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", size])
        for name, size in (("obs", inputs), ("actions", outputs))
    ]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    data: bytes = model.SerializeToString()
    return data


def make_bundle(folder: Path, contract: Contract) -> Path:
    """A bundle of that policy."""
    import onnxruntime

    folder.mkdir()
    size, count = contract.groups[0].shape[0], len(contract.actions)
    model = network(size, count)
    seen = np.random.default_rng(1).standard_normal((4, 1, size), dtype=np.float32)
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    actions = np.stack([session.run(["actions"], {"obs": each})[0] for each in seen])
    np.savez(folder / "parity.npz", obs=seen, begins=np.array([[True], [False], [False], [False]]), actions=actions)
    (folder / "policy.onnx").write_bytes(model)
    (folder / "contract.json").write_text(json.dumps(contract.document()))
    seal(folder, {"run": "benchmark", "checkpoint": "00000001-e1", "train": {}})
    return folder


def percentiles(times: list[float]) -> tuple[float, float, float]:
    """Median, 99th percentile and greatest [ms]."""
    median, most, greatest = np.percentile(np.array(times) * 1e3, [50, 99, 100])
    return float(median), float(most), float(greatest)


class NodeProcess:
    """``muster-policy`` on a bundle, its own router."""

    def __init__(self, bundle: Path, log: Path, *options: str) -> None:
        with socket.socket() as listening:
            listening.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{listening.getsockname()[1]}"
        self.log = log
        command = [sys.executable, "-m", "muster_policy.cli", str(bundle), "--listen", self.endpoint, *options]
        env = {**os.environ, "PYTHONPATH": str(REPOSITORY / "policy_node")}
        with log.open("w") as out:
            self._process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=env)
        while "node /muster_policy" not in log.read_text():
            if self._process.poll() is not None:
                raise SystemExit(log.read_text())
            time.sleep(0.05)

    def end(self) -> str:
        """Stop it; its last line, a summary."""
        self._process.terminate()
        self._process.wait(30)
        return self.log.read_text().splitlines()[-1]


def drive(endpoint: str, robot: Any, rate: float, seconds: float) -> list[float]:
    """Act as a robot at a steady rate: times from just before a step's first message to its command's arrival [s]."""
    from muster_policy.graph import Node, open_session
    from muster_policy.messages import JOINT_STATE
    from muster_policy.timing import sleep_until
    from worker.deploy.simulated_robot import SimulatedRobot

    assert isinstance(robot, SimulatedRobot)
    times: list[float] = []
    began, came = [0.0], threading.Event()

    def commanded(data: bytes, kind: str, type_hash: str) -> None:
        times.append(time.monotonic() - began[0])
        came.set()

    with open_session(endpoint, None) as session:
        node = Node(session, robot.messages, name="driver")
        node.subscribe("joint_commands", JOINT_STATE, commanded)
        output = robot.measured(0)
        publishers = [node.publisher(topic, kind) for topic, kind, _ in output]
        deadline = time.monotonic() + 1.0
        ends = deadline + seconds
        while deadline < ends:
            sleep_until(deadline)
            began[0] = time.monotonic()
            for publisher, (_, _, message) in zip(publishers, output, strict=True):
                publisher.publish(message)
            deadline += 1.0 / rate
        time.sleep(0.2)
        node.close()
    return times


def in_process(bundle: Path, robot: Any) -> dict[str, tuple[float, float, float]]:
    """Times of inference alone, and of a whole step from bytes to bytes, without a network [ms]."""
    from muster_policy.actions import Commands
    from muster_policy.bundle import open_bundle
    from muster_policy.inputs import Inputs
    from muster_policy.messages import JOINT_STATE
    from muster_policy.observations import Observations
    from muster_policy.policy import Policy

    opened = open_bundle(bundle)
    policy, observations, commands = Policy(opened), Observations(opened.contract), Commands(opened.contract)
    messages = robot.messages
    inputs = Inputs(observations, messages)
    encoded = {topic: (messages.encode(message, kind), kind) for topic, kind, message in robot.measured(0)}
    bare, whole = [], []
    seen = {"obs": np.zeros((1, opened.contract.groups[0].shape[0]), np.float32)}
    for _ in range(3000):
        start = time.perf_counter()
        policy.act(seen)
        bare.append(time.perf_counter() - start)
        start = time.perf_counter()
        for each in inputs.all:
            each.waiting = encoded[each.topic][0], 0.0
        inputs.update()
        action = policy.act(observations.build(inputs.snapshot(0.0)))[0]
        (message,) = commands.joint_states(commands.command(action), messages, 0)
        messages.encode(message, JOINT_STATE)
        whole.append(time.perf_counter() - start)
    return {"inference alone": percentiles(bare), "a step from bytes to bytes": percentiles(whole)}


def row(name: str, runs: list[tuple[float, float, float]]) -> str:
    """Medians of several runs, with the range of the 99th percentiles."""
    middle = [statistics.median(each) for each in zip(*runs, strict=True)]
    span = f"{min(each[1] for each in runs):.2f} to {max(each[1] for each in runs):.2f}"
    return f"| {name} | {middle[0]:.3f} | {middle[1]:.3f} | {span} | {middle[2]:.2f} |"


def reached(found: Measured) -> str:
    """At which rates the goal is reached, and at which it is missed."""
    words: dict[bool, list[str]] = {True: [], False: []}
    for rate in RATES:
        middle = statistics.median(p99 for _, p99, _ in found[f"{ANSWER}, {rate:g} Hz"])
        words[middle < GOAL].append(f"{rate:g} Hz ({middle:.2f} ms)")
    reported = [
        f"{verb} at {' and '.join(rates)}"
        for verb, rates in (("reached", words[True]), ("missed", words[False]))
        if rates
    ]
    return " and ".join(reported)


def measure(folder: Path) -> Measured:
    """Times of each row, of each run."""
    import dataclasses

    from muster_policy.messages import Messages
    from worker.deploy.simulated_robot import SimulatedRobot
    from worker.tasks import Task, find_task
    from worker.tasks.run.policy_contract import policy_contract

    task_type = find_task("Go1Flat")
    task = task_type(task_type.config_type(), 1, device="cpu")
    contract = policy_contract(task, "Go1Flat")
    groups = tuple(group for group in contract.groups if group.name == "policy")
    inputs = tuple(dataclasses.replace(group, input="obs") for group in groups)
    assert isinstance(task, Task)
    robot = SimulatedRobot(task, dataclasses.replace(contract, groups=inputs), Messages())
    bundle = make_bundle(folder / "bundle", robot.contract)
    found: Measured = {}
    for _ in range(REPEATS):
        for name, times in in_process(bundle, robot).items():
            found.setdefault(f"in one process: {name}", []).append(times)
        for rate in RATES:
            common = ("--rate", f"{rate:g}", "--timeout", "1")
            node = NodeProcess(bundle, folder / "log", "--trigger", "joint_states", *common)
            took = drive(node.endpoint, robot, rate, SECONDS)
            node.end()
            if len(took) < 0.5 * SECONDS * rate:
                raise SystemExit(f"only {len(took)} commands in {SECONDS:g} s at {rate:g} Hz")
            found.setdefault(f"{ANSWER}, {rate:g} Hz", []).append(percentiles(took))
        for rate in RATES:
            common = ("--rate", f"{rate:g}", "--timeout", "1")
            node = NodeProcess(bundle, folder / "log", *common)
            drive(node.endpoint, robot, 50.0, SECONDS)
            late = re.search(r"late p50 ([\d.]+), p99 ([\d.]+), max ([\d.]+) ms", output := node.end())
            if late is None:
                raise SystemExit(f"the node did not act: {output}")
            p50, p99, most = map(float, late.groups())
            found.setdefault(f"step later than its deadline, {rate:g} Hz", []).append((p50, p99, most))
    return found


def main() -> None:
    """Measure, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_option(parser)
    watch = Watch(parser.parse_args().loaded_anyway)
    with tempfile.TemporaryDirectory() as directory:
        found = measure(Path(directory))
    rows = [row(name, runs) for name, runs in found.items()]
    intro = (
        f"`python -m benchmarks.policy_node` on {machine()}: medians of {REPEATS} runs of {SECONDS:g} s each, in ms. Policy and "
        f"messages of Go1Flat, layers of {', '.join(map(str, LAYERS))}. Node and driver are two processes of this machine; the node is "
        f"the router. {reported([watch.check('while it was measured'), watch.start])}"
    )
    head = ["| what | p50 | p99 | p99 of the runs | max |", "|---|---|---|---|---|"]
    end = (
        f"The goal for {ANSWER} is a p99 below {GOAL:g} ms: {reached(found)}. An earlier bridge to ROS 2 took "
        f"{BRIDGE} ms, on another machine and with another policy. The time is from before the first of four messages is put to "
        "the command's arrival at the driver, decoding and encoding included."
    )
    text = "\n".join(["# The policy node", "", intro, "", *head, *rows, "", end, ""])
    (REPOSITORY / "benchmarks" / "policy_node.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
