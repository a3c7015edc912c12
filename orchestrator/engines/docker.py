"""The Docker engine: nodes are containers of the job's own image, on a private network of their gang's own.

What AWS Batch will run, tried at home first. In an image that has Muster in it (label ``muster.version``) the command runs under the
supervisor, with the store at ``/muster/store``; in any other it runs plainly, and this engine writes its log and its outcome.
Containers and networks carry the gang's name as a label: a restarted controller finds them by it. They go when the gang is stopped.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import ipaddress
import json
import logging
import os
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import docker
from docker.errors import APIError, DockerException, ImageNotFound, NotFound
from docker.models.containers import Container
from docker.models.images import Image
from docker.models.networks import Network
from docker.types import IPAMConfig, IPAMPool, Mount

from orchestrator.engines.base import (
    HERE,
    EngineError,
    Gang,
    GangStatus,
    Host,
    NodePlan,
    NodeStatus,
    NotYet,
    Plan,
    node_plans,
)
from orchestrator.engines.docker_answers import NoAnswer, answered, unanswered
from orchestrator.engines.docker_logs import LogCopy
from orchestrator.engines.docker_options import limits, linux
from orchestrator.engines.gpus import visible_gpus
from orchestrator.engines.mounts import mounts_of
from shared_store import __version__
from shared_store.contract import BUS_VARIABLES, sealed_in_image
from shared_store.files import DamagedFile
from shared_store.layout import Store
from shared_store.log_files import LIMIT
from shared_store.outcomes import Outcome, read_outcome, write_outcome

log = logging.getLogger("muster.engines")

STORE, KERNELS = "/muster/store", "/muster/kernels"
"""Where a container of an image with Muster finds the store and the cache of compiled kernels."""
_GANG, _NODE = "muster.gang", "muster.node"
"""Labels of containers and networks."""
_VERSION = "muster.version"
"""Label of images that have Muster in them."""
_REMEMBERED = 256
"""Gangs whose nodes' exit codes are told after their containers are gone: the controller asks once more when all has ended."""
_PORT = 29500
_TRIES = 64
"""Subnets that are tried before a gang can't be started: others on this machine may hold some."""
_LOOK = 1.0
"""Seconds for which a look at a node waits for the rest of its log."""


class DockerEngine:
    """One machine's Docker Engine."""

    name = "docker"
    queues = False
    elastic = False
    images = True

    def __init__(self, home: Path, cpus: float | None = None, gpus: Sequence[str] | None = None) -> None:
        """Args:
        home: ``$MUSTER_HOME``; the kernel cache goes below it.
        cpus: CPU cores to hand out; the engine's by default.
        gpus: Ids of the GPUs to hand out; those that the driver lists by default.

        Raises:
            EngineError: No Docker Engine answers.
        """
        try:
            self._client = docker.from_env(timeout=120)
            info = self._client.info()
        except (DockerException, OSError, ValueError) as error:  # ValueError: of a DOCKER_HOST with half a port
            raise EngineError(unanswered(error)) from error
        self._cores = float(info["NCPU"])
        self._host = Host(
            f"docker/{info['Name']}",
            cpus or self._cores,
            tuple(gpus if gpus is not None else visible_gpus()),
            int(info["MemTotal"] / 2**20),
            machine=HERE if _is_here(str(self._client.api.base_url), str(info["Name"])) else "",
        )
        self.address = self._gateway()
        self._kernels = Path(os.environ.get("WARP_CACHE_PATH", home / "kernels"))
        self._pulls: dict[str, Future[Image]] = {}
        self._puller = ThreadPoolExecutor(2, thread_name_prefix="pull")
        self._copies: dict[str, LogCopy] = {}
        self._copying = threading.Lock()
        """Held where a copy is looked for and begun: a log has one writer."""
        self._ended: dict[str, dict[int, NodeStatus]] = {}
        self._away = False

    def capacity(self) -> Sequence[Host]:
        return [self._host]

    def plan(self, gang: Gang) -> Plan:
        """With the addresses of the first subnet that would be tried."""
        return Plan(gang, self._nodes(gang, _addresses(_subnet(gang.name, 0), len(gang.placements))))

    def launch(self, plan: Plan) -> str:
        with answered():
            return self._launch(plan)

    def observe(self, handle: str) -> GangStatus:
        """While Docker Engine does not answer, the nodes count as running."""
        facts = json.loads(handle)
        try:
            with answered():
                status = self._observe(facts)
            self._away = False
        except NoAnswer as error:
            if not self._away:  # said once, not at every look
                log.warning("engine docker: %s", error)
            self._away = True
            return [NodeStatus(True, address, waiting=str(error)) for address in facts["addresses"]]
        return status

    def stop(self, handle: str, grace: float) -> None:
        facts = json.loads(handle)
        with answered():
            found = self._containers(facts["gang"])
            if found:
                with ThreadPoolExecutor(len(found)) as pool:
                    list(pool.map(lambda container: _stop(container, grace), found.values()))
                # what is not copied yet would go with the container
                for copy in self._copies_of(facts["gang"]).values():
                    copy.wait()
            self._ended[facts["gang"]] = dict(enumerate(self._observe(facts)))
            for gang in list(self._ended)[:-_REMEMBERED]:  # other stops do the same
                self._ended.pop(gang, None)
            self._remove(facts["gang"])

    def close(self) -> None:
        """Containers go on."""
        self._puller.shutdown(wait=False, cancel_futures=True)
        self._client.close()

    def _gateway(self) -> str | None:
        """Address of this machine on Docker's default bridge, which containers of every network reach; None if it has none."""
        try:
            [config] = self._client.networks.get("bridge").attrs["IPAM"]["Config"]
            # an engine that found the bridge already there leaves the gateway out: then it is the subnet's first address
            address = config.get("Gateway") or str(next(ipaddress.ip_network(config["Subnet"]).hosts()))
            with socket.socket() as probe:
                probe.bind((address, 0))
            return str(address)
        except (DockerException, KeyError, ValueError, OSError):  # an engine on another machine, or without a bridge
            return None

    # -- starting -----------------------------------------------------------------------------------------------------

    def _launch(self, plan: Plan) -> str:
        gang = plan.gang
        images = [self._image(str(container.get("image") or "")) for container in gang.containers]
        there = self._containers(gang.name)
        for index, (image, command) in enumerate(zip(images, gang.commands, strict=True)):
            if index not in there:
                _check_image(str(gang.containers[index]["image"]), image, command)
        network, subnet = self._network(gang.name)
        addresses = _addresses(subnet, len(gang.placements))
        nodes = self._nodes(gang, addresses)
        run = Store(gang.store).run(gang.run)
        facts = {**_facts(gang), "addresses": addresses}
        try:
            for index in sorted(range(len(nodes)), key=lambda index: index != gang.main):
                if index in there:
                    if there[index].status == "created":  # the controller was killed between the two
                        there[index].start()
                elif read_outcome(run, gang.job, gang.attempt, index) is None:
                    container = self._create(gang, nodes[index], images[index], network, addresses[index])
                    container.start()
                    self._follow(container, facts, index)
        except BaseException as error:
            self._remove(gang.name)  # never half a gang
            # 500: it has tried, and said why it can't; beyond that nobody has
            if isinstance(error, APIError) and (error.status_code or 500) <= 500:
                why = f"CannotStartContainerError: Error response from daemon: {error.explanation}"
                raise EngineError(why) from error
            raise
        return json.dumps(facts)

    def _image(self, name: str) -> Image:
        """The image; where it is not here it is pulled meanwhile. Raises NotYet, and EngineError in AWS's words."""
        try:
            return self._client.images.get(name)
        except ImageNotFound:
            pass
        except DockerException as error:
            if isinstance(error, APIError) and error.is_server_error():
                raise
            raise EngineError(f"CannotInspectContainerError: image {name!r}: {error}") from error
        pull = self._pulls.pop(name, None) or self._puller.submit(self._client.images.pull, name)
        if not pull.done():
            self._pulls[name] = pull
            raise NotYet(f"pulling image {name}")
        try:
            return pull.result()
        except DockerException as error:
            why = error.explanation if isinstance(error, APIError) and error.explanation else str(error)
            why = f"CannotPullContainerError: Error response from daemon: {why} (image {name})"
            raise EngineError(why) from error

    def _network(self, gang: str) -> tuple[Network, str]:
        """The gang's network and its subnet, ``a.b.c.0/24``."""
        for network in self._client.networks.list(filters={"label": f"{_GANG}={gang}"}):
            return network, network.attrs["IPAM"]["Config"][0]["Subnet"]
        problem = ""
        for salt in range(_TRIES):
            subnet = _subnet(gang, salt)
            try:
                network = self._client.networks.create(
                    f"muster-{gang.replace('/', '-')}",
                    driver="bridge",
                    ipam=IPAMConfig(pool_configs=[IPAMPool(subnet=subnet)]),
                    labels={_GANG: gang},
                )
                return network, subnet
            except APIError as error:
                problem = error.explanation or str(error)
                if "overlaps" not in problem:
                    break
        raise EngineError(f"no network for the gang: {problem}")

    def _create(self, gang: Gang, node: NodePlan, image: Image, network: Network, address: str) -> Container:
        container = gang.containers[node.contract.node_index]
        supervised = _VERSION in (image.labels or {})
        entrypoint = list((image.attrs.get("Config") or {}).get("Entrypoint") or [])
        options = {**limits(container, node, self._cores), **linux(container)}
        mounts = [Mount(m.target, m.source, "bind", read_only=m.read_only) for m in mounts_of(container, gang.store)]
        environment = {**node.environment, **node.contract.to_env()}
        if supervised:
            self._kernels.mkdir(parents=True, exist_ok=True)
            mounts += [Mount(STORE, gang.store, "bind"), Mount(KERNELS, str(self._kernels), "bind")]
            job = {"HOME": "/tmp", "WARP_CACHE_PATH": KERNELS, **node.environment}
            environment = {"HOME": "/tmp", **sealed_in_image(job, node.contract.to_env())}
            # whoever owns the store writes it; that is seldom the user that the image names
            owner = Path(gang.store).stat()
            options.setdefault("user", f"{owner.st_uid}:{owner.st_gid}")
            command = [*entrypoint, *node.command]
            entrypoint = ["python", "-P", "-m", "worker.supervisor", "--"]
        else:
            command = list(node.command)
            environment = {name: value for name, value in environment.items() if name not in BUS_VARIABLES}
        return self._client.containers.create(
            image,
            command,
            entrypoint=entrypoint or None,
            name=f"muster-{gang.name.replace('/', '-')}-{node.contract.node_index}",
            hostname=f"node-{node.contract.node_index}",
            environment=environment,
            labels={_GANG: gang.name, _NODE: str(node.contract.node_index), "muster.plain": "" if supervised else "1"},
            mounts=mounts,
            network=network.name,
            networking_config={network.name: self._client.api.create_endpoint_config(ipv4_address=address)},
            **options,
        )

    def _nodes(self, gang: Gang, addresses: Sequence[str]) -> list[NodePlan]:
        bus = gang.bus if self.address else None  # on loopback no container would find it
        return node_plans(dataclasses.replace(gang, store=STORE, bus=bus), addresses, _PORT)

    # -- watching -----------------------------------------------------------------------------------------------------

    def _containers(self, gang: str) -> dict[int, Container]:
        found = self._client.containers.list(all=True, filters={"label": f"{_GANG}={gang}"}, ignore_removed=True)
        return {int(container.labels[_NODE]): container for container in found}

    def _observe(self, facts: Mapping[str, Any]) -> GangStatus:
        found, ended = self._containers(facts["gang"]), self._ended.get(facts["gang"], {})
        status = []
        for index, address in enumerate(facts["addresses"]):
            container = found.get(index)
            if container is None:
                status.append(ended.get(index) or NodeStatus(False, address))
                continue
            self._follow(container, facts, index)
            status.append(self._status(container, facts, index, address))
        return status

    def _status(self, container: Container, facts: Mapping[str, Any], index: int, address: str) -> NodeStatus:
        state = container.attrs["State"]
        if state["Status"] in ("created", "running", "paused", "restarting"):
            return NodeStatus(True, address)
        code, detail = int(state["ExitCode"]), state.get("Error") or ""
        if state.get("OOMKilled"):
            detail = "OutOfMemoryError: Container killed due to memory usage"
        if container.labels.get("muster.plain"):
            if not self._settle(facts, index, state, detail):
                return NodeStatus(True, address, waiting="its container has ended, its log is still being copied")
        elif code and not detail:
            try:
                detail = container.logs(tail=1).decode(errors="replace").strip()
            except APIError:  # a logging driver that can't be read
                detail = ""
        return NodeStatus(False, address, code, detail)

    def _settle(self, facts: Mapping[str, Any], index: int, state: Mapping[str, Any], detail: str) -> bool:
        """What a supervisor does at the end of its node, for one without: the log is whole, then the outcome is written.

        False while the log is not whole yet.
        """
        copy = self._copies.get(f"{facts['gang']}/{index}")
        if copy is not None:
            if not copy.wait(_LOOK):
                return False
            if copy.trouble is not None and not isinstance(copy.trouble, APIError | DamagedFile):  # these will stay
                raise copy.trouble
        run = Store(facts["store"]).run(facts["run"])
        if read_outcome(run, facts["job"], facts["attempt"], index) is not None or not run.path.exists():
            return True
        code = int(state["ExitCode"])
        reason = detail or ("done" if code == 0 else f"container exited with code {code}")
        ended = time.time()
        outcome = Outcome(index, facts["epoch"], code, None, reason, None, ended, ended)
        with contextlib.suppress(DamagedFile):  # a link in its place: what Docker says of the container counts then
            write_outcome(run, facts["job"], facts["attempt"], outcome)
        return True

    def _follow(self, container: Container, facts: Mapping[str, Any], index: int) -> None:
        """Copy the log of a container without a supervisor into the run's, from where it was copied to before."""
        if not container.labels.get("muster.plain"):
            return
        key, run = f"{facts['gang']}/{index}", Store(facts["store"]).run(facts["run"])
        with self._copying:  # a gang that is being stopped is looked at by two threads
            before = self._copies.get(key)
            if before is not None and not before.is_due_again:
                return
            if read_outcome(run, facts["job"], facts["attempt"], index) is not None:
                return
            path, limit = run.log(facts["job"], facts["attempt"], index), facts.get("log_limit", LIMIT)
            self._copies[key] = LogCopy(container, path, limit, before)

    def _remove(self, gang: str) -> None:
        for container in self._containers(gang).values():
            try:
                container.remove(force=True)
            except NotFound:
                pass
        for network in self._client.networks.list(filters={"label": f"{_GANG}={gang}"}):
            try:
                network.remove()
            except APIError:
                pass  # a container that is still going; the next stop removes it
        keys = list(self._copies_of(gang))
        with self._copying:  # another thread may look through them
            for key in keys:
                self._copies.pop(key, None)

    def _copies_of(self, gang: str) -> dict[str, LogCopy]:
        """The copies of a gang's logs, by their keys."""
        with self._copying:
            return {key: copy for key, copy in self._copies.items() if key.startswith(f"{gang}/")}


def _check_image(name: str, image: Image, command: Sequence[str]) -> None:
    """Raises EngineError where the image lacks the Muster that the command needs, or has another one than the controller."""
    version = (image.labels or {}).get(_VERSION)
    module = next((b for a, b in pairwise(command) if a == "-m" and b.startswith("worker.")), None)
    if version is None and module is not None:
        raise EngineError(
            f"image {name} has no Muster in it (no label {_VERSION}), which {module} needs: build it FROM the image of "
            "containers/Dockerfile"
        )
    if version not in (None, __version__):
        raise EngineError(
            f"image {name} has Muster {version}, the controller {__version__}: build it anew with the controller's version"
        )


def _is_here(url: str, name: str) -> bool:
    """Whether the Docker Engine at ``url``, on a machine of this name, is this machine's own.

    A socket is taken for that, also by a controller in a container, which has another host name. One that is forwarded from
    another machine is not: there less is handed out than there is, and never anything twice.
    """
    host = urlsplit(url).hostname  # docker-py has "localhost" for a Unix socket, and "ssh" for a machine behind SSH
    return host in ("localhost", "127.0.0.1", "::1") or name == socket.gethostname()


def _facts(gang: Gang) -> dict[str, Any]:
    """What a handle remembers."""
    return {
        "gang": gang.name,
        "job": gang.job,
        "attempt": gang.attempt,
        "epoch": gang.epoch,
        "run": gang.run,
        "store": gang.store,
        "log_limit": gang.log_limit,
    }


def _subnet(gang: str, salt: int) -> str:
    """One of 8,192 networks of 10.192.0.0/11, by the gang's name; another one for each ``salt``."""
    digest = hashlib.sha256(f"{gang}#{salt}".encode()).digest()
    return f"10.{192 + digest[0] % 32}.{digest[1]}.0/24"


def _addresses(subnet: str, count: int) -> list[str]:
    """The nodes' addresses; the first of the subnet is the network's gateway."""
    if count > 250:
        raise EngineError(f"{count} nodes: the docker engine has room for 250 on a gang's network")
    return [f"{subnet.rpartition('.')[0]}.{index + 2}" for index in range(count)]


def _stop(container: Container, grace: float) -> None:
    """SIGTERM, ``grace`` seconds later SIGKILL; a paused one can't be asked."""
    try:
        if container.status == "paused":
            container.unpause()
            container.kill()
        elif container.status == "created":
            return
        else:
            container.stop(timeout=int(max(1.0, grace)))
    except (NotFound, APIError):
        pass  # it ended meanwhile, or is being removed
