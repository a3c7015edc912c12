"""A real Ray cluster on this machine: a head and raylets started with ``ray start``, each at a loopback address of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from tests.support.processes import command, find_processes, session_of, signal_all
from tests.support.waiting import wait_for
from tests.support.worker.ranks import free_port

RAY = str(Path(sys.executable).parent / "ray")
_SMALL = ["--object-store-memory=80000000", "--min-worker-port=0", "--max-worker-port=0", "--include-log-monitor=false"]

IMPATIENT = {"RAY_health_check_period_ms": "1000", "RAY_health_check_timeout_ms": "3000"}
"""Of a head: a node that five times in a row does not answer is given up after 20 s, not after 65."""


class RayCluster:
    """Processes are ended by their session, never with ``ray stop``, which ends everybody's."""

    def __init__(self, home: Path, head_options: tuple[str, ...] = (), port: int = 0, **env: str) -> None:
        """``head_options``, ``env``: more of them for the head."""
        self.home, self.head_options, self.head_env = home, head_options, env
        # the head listens at all of the machine's addresses: two of them need two ports
        self.address, self.modules = f"{self.network()}.1:{port or free_port()}", home / "modules"
        token = home / "token"
        token.write_text("a-token-that-is-long-enough-for-a-test")
        token.chmod(0o600)
        self.variables = {
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN_PATH": str(token),
            "RAY_ADDRESS": self.address,
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_enable_worker_prestart": "0",  # two cores have other things to do
            "RAY_prestart_worker_first_driver": "0",
            "RAY_worker_niceness": "0",  # 15 is Ray's own: other tests of the machine would go first
            "RAY_raylet_start_wait_time_s": "120",
        }
        self.nodes: dict[str, subprocess.Popen[bytes]] = {}
        self._number = 1
        self._short = Path(f"/tmp/muster-ray-{os.getpid()}-{id(self) % 10000}")  # a socket's path may have 107 letters
        self.start_head()

    @staticmethod
    def network() -> str:
        """The first three numbers of the addresses: others for each process that runs tests."""
        return f"127.{100 + os.getpid() % 100}.{os.getpid() // 100 % 250}"

    def start_head(self) -> None:
        """GCS on a disk: a head that is started again goes on where it was."""
        (self.home / "gcs").mkdir(exist_ok=True)
        (self._short / "ray_current_cluster").unlink(missing_ok=True)  # else raylets on this machine count as a head
        self._start(
            "head",
            [
                *(
                    "--head",
                    f"--port={self.address.rpartition(':')[2]}",
                    "--num-cpus=0",
                    "--include-dashboard=false",
                    *self.head_options,
                ),
                *(f"--ray-client-server-port={free_port()}", f"--node-ip-address={self.network()}.1"),
            ],
            {
                "RAY_gcs_storage": "rocksdb",
                "RAY_gcs_storage_path": str(self.home / "gcs"),
                **IMPATIENT,
                **self.head_env,
            },
        )

    def add(self, *names: str, cpus: int = 2, gpus: int = 2, **env: str) -> None:
        """More nodes, one after the other: raylets that start at once on one machine get in each other's way."""
        for name in names:
            self._number += 1
            options = [f"--address={self.address}", f"--node-ip-address={self.network()}.{self._number}"]
            self._start(name, [*options, f"--num-cpus={cpus}", f"--num-gpus={gpus}", "--memory=2000000000"], env)
            self.ready(name)

    def ready(self, name: str) -> None:
        def up() -> bool:
            assert self.nodes[name].poll() is None, self._log(name).read_text()[-3000:]
            return "block forever" in self._log(name).read_text()

        wait_for(up, 60, f"Ray node {name}")

    def kill(self, name: str) -> None:
        """SIGKILL to all that the node is, at once, as when its machine loses its power."""
        node = self.nodes.pop(name)
        signal_all(self.pids(node.pid), signal.SIGKILL)
        node.wait()

    def raylet(self, name: str) -> int:
        [pid] = [pid for pid in self.pids(self.nodes[name].pid) if "raylet/raylet" in command(pid)[0]]
        return pid

    def pids(self, session: int) -> list[int]:
        return find_processes(lambda pid: session_of(pid) == session)

    def close(self) -> None:
        for name in sorted(self.nodes, key=lambda name: name == "head"):
            self.kill(name)
        subprocess.run(["rm", "-rf", str(self._short)], check=True)

    def _start(self, name: str, options: list[str], env: dict[str, str]) -> None:
        temporary = [f"--temp-dir={self._short}"]
        with open(self._log(name), "wb") as log:
            self.nodes[name] = subprocess.Popen(
                [RAY, "start", "--block", f"--node-name={name}", *options, *_SMALL, *temporary],
                env={**os.environ, **self.variables, **env},
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        if name == "head":
            self.ready(name)

    def _log(self, name: str) -> Path:
        return self.home / f"{name}.log"
