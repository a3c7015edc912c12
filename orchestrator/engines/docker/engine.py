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
from docker.types import IPAMConfig, IPAMPool

from orchestrator.domain.hosts import HERE, Host, Hosts
from orchestrator.engines.api import (
    CannotStart,
    Cause,
    EngineError,
    Gang,
    GangStatus,
    Handle,
    NodePhase,
    NodeStatus,
    NotYet,
    Plan,
    StatusOrError,
    node_plans,
)
from orchestrator.engines.docker import TRAITS
from orchestrator.engines.docker.answers import answered, unanswered
from orchestrator.engines.docker.logs import FollowedLog
from orchestrator.engines.docker.request import GANG, NODE, PLAIN, STORE, ContainerRequest, container_request
from orchestrator.engines.toolkit.gpus import visible_gpus
from orchestrator.engines.toolkit.outcomes import log_of, record, recorded, seen, store_facts
from orchestrator.engines.toolkit.statuses import ended, one_by_one
from orchestrator.engines.toolkit.waiting import stop_within
from shared_store import __version__
from shared_store.contract.error_text import counted
from shared_store.volume.files import DamagedFile
from shared_store.volume.layout import Store
from shared_store.volume.node_outcomes import OUT_OF_MEMORY, read_outcome

log = logging.getLogger("muster.engines")

_VERSION = "muster.version"
"""Label of images that have Muster in them."""
_REMEMBERED = 256
"""Number of gangs whose exit codes are kept after their containers are gone: the controller looks once more after the end."""
_PORT = 29500
_TRIES = 64
"""Subnets that are tried before a gang can't be started: others on this machine may hold some."""
_LOOK = 1.0
"""Seconds for which a look at a node waits for the rest of its log."""
_COPYING = 300.0
"""Seconds for which a stop waits for the logs of containers that have ended."""
_RUNNING = ("created", "running", "paused", "restarting")
"""States of a container that has not ended."""


class DockerEngine:
    """One machine's Docker Engine."""

    name = "docker"
    traits = TRAITS

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
        self._pulling = threading.Lock()
        """Held where a pull is looked for and begun: several gangs may be launched at once."""
        self._puller = ThreadPoolExecutor(2, thread_name_prefix="pull")
        self._copies: dict[str, FollowedLog] = {}
        self._copying = threading.Lock()
        """Held where a copy is looked for and begun: a log has one writer."""
        self._ended: dict[str, dict[int, NodeStatus]] = {}
        self._unreachable = False

    def capacity(self) -> Hosts:
        return Hosts([self._host])

    def plan(self, gang: Gang) -> Plan[Sequence[ContainerRequest]]:
        """With the addresses of the first subnet that would be tried."""
        bus = gang.bus if self.address else None  # on loopback no container would find it
        addresses = _addresses(_subnet(gang.name, 0), len(gang.placements))
        nodes = node_plans(dataclasses.replace(gang, store=STORE, bus=bus), addresses, _PORT)
        return Plan(gang, nodes, [container_request(gang, node, self._cores) for node in nodes])

    def launch(self, plan: Plan[Sequence[ContainerRequest]]) -> Handle:
        with answered():
            return self._launch(plan)

    def observe(self, handles: Sequence[Handle]) -> Sequence[StatusOrError]:
        """In one request for all gangs, and one more for each container that has ended or whose log is not copied yet.

        While Docker Engine does not answer, the nodes count as running.
        """
        try:
            with answered():
                listed = self._listed()
        except NotYet as error:
            if not self._unreachable:  # reported once, not at every look
                log.warning("engine docker: %s", error)
            self._unreachable = True
            return [
                [NodeStatus(NodePhase.UNREACHABLE, address, str(error)) for address in handle.facts["addresses"]]
                for handle in handles
            ]
        self._unreachable = False
        return one_by_one(lambda handle: self._observe(handle, listed.get(handle.gang, {})), handles)

    def stop(self, handle: Handle, grace: float) -> None:
        with answered():
            found = self._containers(handle.gang)
            if found:
                with ThreadPoolExecutor(len(found)) as pool:
                    list(pool.map(lambda container: _stop(container, grace), found.values()))
                # what is not copied yet would go with the container
                copies = list(self._copies_of(handle.gang).values())

                def uncopied() -> str:
                    left = sum(not copy.wait(0.0) for copy in copies)
                    return f"{counted(left, 'log')} not copied to the end" if left else ""

                stop_within(_COPYING, uncopied, engine=self.name, gang=handle.gang, pause=0.05)
            self._ended[handle.gang] = dict(
                enumerate(self._observe(handle, self._listed(handle.gang).get(handle.gang, {})))
            )
            for gang in list(self._ended)[:-_REMEMBERED]:  # other stops do the same
                self._ended.pop(gang, None)
            self._remove(handle.gang)

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

    def _launch(self, plan: Plan[Sequence[ContainerRequest]]) -> Handle:
        gang = plan.gang
        images = [self._image(request.image) for request in plan.request]
        existing = self._containers(gang.name)
        for index, (image, node) in enumerate(zip(images, gang.nodes, strict=True)):
            if index not in existing:
                _check_image(plan.request[index].image, image, node.command)
        network, subnet = self._network(gang.name)
        addresses = _addresses(subnet, len(gang.placements))
        requests = [r.at(addresses[index], addresses[gang.main]) for index, r in enumerate(plan.request)]
        run = Store(gang.store).run(gang.run)
        handle = Handle(self.name, gang.name, len(requests), {**store_facts(gang), "addresses": addresses})
        try:
            for index in sorted(range(len(requests)), key=lambda index: index != gang.main):
                if index in existing:
                    if existing[index].status == "created":  # the controller was killed between the two
                        existing[index].start()
                elif read_outcome(run, gang.job, gang.attempt, index) is None:
                    container = self._create(requests[index], images[index], network)
                    container.start()
                    self._follow(container, handle, index)
        except BaseException as error:
            self._remove(gang.name)  # never half a gang
            # up to 500 the daemon tried and explains its failure; above, something between us and the daemon failed
            if isinstance(error, APIError) and (error.status_code or 500) <= 500:
                why = f"CannotStartContainerError: Error response from daemon: {error.explanation}"
                raise CannotStart(why) from error
            raise
        return handle

    def _image(self, name: str) -> Image:
        """The image; where it is not here it is pulled meanwhile. Raises NotYet, and CannotStart in AWS's words."""
        try:
            return self._client.images.get(name)
        except ImageNotFound:
            pass
        except DockerException as error:
            if isinstance(error, APIError) and error.is_server_error():
                raise
            raise CannotStart(f"CannotInspectContainerError: image {name!r}: {error}") from error
        with self._pulling:
            pull = self._pulls.pop(name, None) or self._puller.submit(self._client.images.pull, name)
            if not (done := pull.done()):
                self._pulls[name] = pull
        if not done:
            raise NotYet(f"pulling image {name}")
        try:
            return pull.result()
        except DockerException as error:
            why = error.explanation if isinstance(error, APIError) and error.explanation else str(error)
            why = f"CannotPullContainerError: Error response from daemon: {why} (image {name})"
            raise CannotStart(why) from error

    def _network(self, gang: str) -> tuple[Network, str]:
        """The gang's network and its subnet, ``a.b.c.0/24``."""
        for network in self._client.networks.list(filters={"label": f"{GANG}={gang}"}):
            return network, network.attrs["IPAM"]["Config"][0]["Subnet"]
        problem = ""
        for salt in range(_TRIES):
            subnet = _subnet(gang, salt)
            try:
                network = self._client.networks.create(
                    f"muster-{gang.replace('/', '-')}",
                    driver="bridge",
                    ipam=IPAMConfig(pool_configs=[IPAMPool(subnet=subnet)]),
                    labels={GANG: gang},
                )
                return network, subnet
            except APIError as error:
                problem = error.explanation or str(error)
                if "overlaps" not in problem:
                    break
        raise EngineError(f"no network for the gang: {problem}")

    def _create(self, request: ContainerRequest, image: Image, network: Network) -> Container:
        kernels = self._kernels if _VERSION in (image.labels or {}) else None
        if kernels:
            kernels.mkdir(parents=True, exist_ok=True)
        place = self._client.api.create_endpoint_config(ipv4_address=request.contract.address)
        return self._client.containers.create(
            image,
            network=network.name,
            networking_config={network.name: place},
            **request.arguments(*_own_command(image), kernels),
        )

    # -- watching -----------------------------------------------------------------------------------------------------

    def _containers(self, gang: str) -> dict[int, Container]:
        found = self._client.containers.list(all=True, filters={"label": f"{GANG}={gang}"}, ignore_removed=True)
        return {int(container.labels[NODE]): container for container in found}

    def _listed(self, gang: str = "") -> dict[str, dict[int, Mapping[str, Any]]]:
        """What Docker lists of the containers of all gangs, or of one, by gang and index of the node."""
        found: dict[str, dict[int, Mapping[str, Any]]] = {}
        for each in self._client.api.containers(all=True, filters={"label": f"{GANG}={gang}" if gang else GANG}):
            found.setdefault(each["Labels"][GANG], {})[int(each["Labels"][NODE])] = each
        return found

    def _observe(self, handle: Handle, listed: Mapping[int, Mapping[str, Any]]) -> GangStatus:
        with answered():
            return [self._node(handle, index, listed.get(index)) for index in range(handle.nodes)]

    def _node(self, handle: Handle, index: int, listed: Mapping[str, Any] | None) -> NodeStatus:
        address, container = handle.facts["addresses"][index], None
        runs = NodeStatus(NodePhase.RUNNING, address)
        if listed is not None:
            if listed["State"] in _RUNNING and (PLAIN not in listed["Labels"] or self._is_followed(handle, index)):
                return runs
            with contextlib.suppress(NotFound):  # a stop has removed it since it was listed
                container = self._client.containers.get(listed["Id"])
        if container is None:
            return self._ended.get(handle.gang, {}).get(index) or ended(address, None)
        self._follow(container, handle, index)
        state = container.attrs["State"]
        if state["Status"] in _RUNNING:
            return runs
        status = _ended(state, address)
        if container.labels.get(PLAIN):
            if not self._settle(handle, index, state, status.words):
                return dataclasses.replace(runs, words="its container has ended, its log is still being copied")
        elif status.exit_code and not status.words:
            with contextlib.suppress(APIError):  # a logging driver that can't be read
                words = container.logs(tail=1).decode(errors="replace").strip()
                return dataclasses.replace(status, words=words)
        return status

    def _settle(self, handle: Handle, index: int, state: Mapping[str, Any], words: str) -> bool:
        """Record the end of a node without a supervisor, as a supervisor does: the log is whole, then the outcome is written.

        False while the log is not whole yet.
        """
        copy = self._copies.get(f"{handle.gang}/{index}")
        if copy is not None:
            if not copy.wait(_LOOK):
                return False
            if copy.trouble is not None and not isinstance(copy.trouble, APIError | DamagedFile):  # these will stay
                raise copy.trouble
        record(handle, seen(handle, index, int(state["ExitCode"]), words, time.time()))
        return True

    def _is_followed(self, handle: Handle, index: int) -> bool:
        """Whether the log of a node is being copied."""
        copy = self._copies.get(f"{handle.gang}/{index}")
        return copy is not None and not copy.is_due_again

    def _follow(self, container: Container, handle: Handle, index: int) -> None:
        """Copy the log of a container without a supervisor into the run's, from where it was copied to before."""
        if not container.labels.get(PLAIN):
            return
        key = f"{handle.gang}/{index}"
        with self._copying:  # a gang that is being stopped is looked at by two threads
            if self._is_followed(handle, index) or recorded(handle, index) is not None:
                return
            path, limit = log_of(handle, index)
            self._copies[key] = FollowedLog(container, path, limit, self._copies.get(key))

    def _remove(self, gang: str) -> None:
        for container in self._containers(gang).values():
            with contextlib.suppress(NotFound):
                container.remove(force=True)
        for network in self._client.networks.list(filters={"label": f"{GANG}={gang}"}):
            with contextlib.suppress(APIError):  # a container that is still going; the next stop removes it
                network.remove()
        keys = list(self._copies_of(gang))
        with self._copying:  # another thread may read them
            for key in keys:
                self._copies.pop(key, None)

    def _copies_of(self, gang: str) -> dict[str, FollowedLog]:
        """The copies of a gang's logs, by their keys."""
        with self._copying:
            return {key: copy for key, copy in self._copies.items() if key.startswith(f"{gang}/")}


def _ended(state: Mapping[str, Any], address: str) -> NodeStatus:
    """A node whose container has ended, by the state that Docker tells."""
    code = int(state["ExitCode"])
    if state.get("OOMKilled"):
        return NodeStatus(NodePhase.ENDED, address, OUT_OF_MEMORY, Cause.OUT_OF_MEMORY, code)
    return ended(address, code, str(state.get("Error") or ""))


def _check_image(name: str, image: Image, command: Sequence[str]) -> None:
    """Raises EngineError where the image lacks the command or the Muster that the job needs, or has another one than the controller."""
    problem, version = "", (image.labels or {}).get(_VERSION)
    module = next((b for a, b in pairwise(command) if a == "-m" and b.startswith("worker.")), None)
    if not command and not any(_own_command(image)):
        problem = "has neither ENTRYPOINT nor CMD, and the job no command; give it one"
        raise EngineError(f"CannotCreateContainerError: No command specified: image {name} {problem}")
    if version is None and module is not None:
        problem = f"has no Muster in it (no label {_VERSION}), which {module} needs: build it FROM the image of containers/Dockerfile"
    elif version not in (None, __version__):
        problem = f"has Muster {version}, the controller {__version__}: build it anew with the controller's version"
    if problem:
        raise EngineError(f"image {name} {problem}")


def _own_command(image: Image) -> tuple[list[str], list[str]]:
    """``ENTRYPOINT`` and ``CMD`` of an image."""
    config = image.attrs.get("Config") or {}
    return config.get("Entrypoint") or [], config.get("Cmd") or []


def _is_here(url: str, name: str) -> bool:
    """Whether the Docker Engine at ``url``, on a machine of this name, is this machine's own.

    A socket is taken for that, also by a controller in a container, which has another host name. One that is forwarded from
    another machine is not: there less is handed out than there is, and never anything twice.
    """
    host = urlsplit(url).hostname  # docker-py has "localhost" for a Unix socket, and "ssh" for a machine behind SSH
    return host in ("localhost", "127.0.0.1", "::1") or name == socket.gethostname()


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
        elif container.status != "created":
            container.stop(timeout=int(max(1.0, grace)))
    except APIError as error:  # it ended meanwhile, or is being removed
        if error.is_server_error():  # it may run: who asks again gives it its time again
            raise
