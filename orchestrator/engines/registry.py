"""The registry of engines: several of them as one, for the controller. A host's name and a gang's handle name their engine."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from math import inf
from typing import Any

from orchestrator import machine
from orchestrator.domain.hosts import Capacity, engine_of
from orchestrator.engines.api import (
    Engine,
    EngineError,
    Gang,
    GangStatus,
    Handle,
    NodePhase,
    NodeStatus,
    NotYet,
    Plan,
    SecretValues,
    Traits,
    read_handle,
    unused_user,
)
from orchestrator.engines.installed import traits_of
from orchestrator.engines.runner import Health, Runner
from orchestrator.engines.secrets import Secrets, SecretsError

FRESH = 2.0
"""Seconds that a request waits for the engines' newest hosts."""
START = 5.0
"""Seconds that a controller's start waits for the first answers of its engines; it goes on without those that are later."""


class EngineSet:
    """Engines by their names, each on its own thread; the first is the one that jobs of the queue ``default`` go to."""

    def __init__(self, engines: Sequence[Engine]) -> None:
        """Takes the engines over: :meth:`close` closes them. Waits a little for their first answers."""
        self.secrets = Secrets()
        """The source of the jobs' secrets; none at first."""
        self.changed: Callable[[str], None] = lambda _: None
        """Called (on an engine's thread) with the name of a gang that has changed; empty: what an engine has, did."""
        self.engines: Mapping[str, Engine] = {engine.name: engine for engine in engines}
        self._handles: dict[str, Handle] = {}
        """Of the gangs that are observed, by their text."""
        self._runners = {engine.name: Runner(engine, lambda gang: self.changed(gang)) for engine in engines}
        deadline = machine.monotonic() + START
        for runner in self._runners.values():
            with suppress(TimeoutError, EngineError):
                machine.result(runner.first, max(0.0, deadline - machine.monotonic()))

    def close(self) -> None:
        """Close every engine; gangs go on."""
        with ExitStack() as stack:  # one that can't be closed does not keep the others open
            for runner in self._runners.values():
                stack.callback(runner.close)

    def arrange(self, names: Sequence[str]) -> None:
        """Take the engines in this order: all of them, by their names."""
        self.engines = {name: self.engines[name] for name in names}

    @property
    def names(self) -> Sequence[str]:
        return list(self.engines)

    def is_elastic(self, names: Iterable[str]) -> bool:
        """Whether one of these engines may have more hosts later."""
        return any(self.engines[name].traits.elastic for name in names if name in self.engines)

    @property
    def addresses(self) -> Sequence[str]:
        """Of this machine as the engines' nodes see it, beside loopback."""
        return sorted({engine.address for engine in self.engines.values() if engine.address})

    def capacity(self, names: Iterable[str] | None = None, patience: float = 0.0) -> Mapping[str, Capacity]:
        """The capacity of all engines, or of these, by their names, as each reported it last; without those that have not reported it yet.

        ``patience``: seconds to wait for newer answers, at most. The controller's own loop waits for none.
        """
        deadline = machine.monotonic() + patience
        requested = [name for name in (self.engines if names is None else names) if name in self._runners]
        known = {name: self._runners[name].capacity(max(0.0, deadline - machine.monotonic())) for name in requested}
        return {name: capacity for name, capacity in known.items() if capacity is not None}

    def unknown(self) -> Mapping[str, str]:
        """Why it is not known what an engine has, by the names of those that have not reported it yet."""
        return {name: why for name, runner in self._runners.items() if (why := runner.unknown) is not None}

    def health(self) -> Mapping[str, Health]:
        """The answers of each engine, by its name."""
        return {name: runner.health for name, runner in self._runners.items()}

    def plan(self, gang: Gang) -> Plan[Any]:
        """As the engine plans it. Raises EngineError, also where an image is named that it would not run and must not pass over."""
        runner = self._runner(engine_of(gang.placements[0].host))
        engine, traits = runner.engine, runner.engine.traits
        name = f"the {engine.name} engine"
        if not traits.images and not all(node.command for node in gang.nodes):
            raise EngineError(f"the job has no command, and {name} runs no image that could have one; give it one")
        images = {str(node.container.get("image") or "muster") for node in gang.nodes} - {"muster"}
        if images and not traits.images and gang.options.get("images") == "refuse":
            raise EngineError(
                f"image {min(images)}: {name} runs commands in its nodes' own environment, and compute environment "
                f"{gang.compute_environment} refuses other images (tag muster:images)"
            )
        if _has_secrets(gang) and traits.secrets is SecretValues.NONE:
            raise EngineError(f"secrets: {name} has no safe way to hand them to its nodes")
        if traits.images:  # its containers are what others have to imitate
            gang = replace(gang, isolated=False)
        elif not traits.users:
            why = f"{name} runs jobs as the user of its nodes"
            nodes = list(gang.nodes)
            for index, node in enumerate(nodes):
                if user := node.container.get("user"):
                    note = "; ".join(filter(None, (node.note, unused_user(user, why))))
                    nodes[index] = replace(node, note=note)
            gang = replace(gang, nodes=nodes)
        if gang.bus and engine.address:
            gang = replace(gang, bus=f"tcp/{engine.address}:{gang.bus.rpartition(':')[2]}")
        return runner.plan(gang)

    def with_secrets(self, gang: Gang) -> Gang:
        """The gang with the values of the job's secrets in its nodes' environments: to be launched, not to be shown.

        Raises EngineError.
        """
        way = self._traits(engine_of(gang.placements[0].host)).secrets
        if way is not SecretValues.ENVIRONMENT or not _has_secrets(gang):
            return gang
        try:
            values = [self.secrets.of(node.container, gang.queue) for node in gang.nodes]
        except SecretsError as error:
            raise EngineError(str(error)) from None
        pairs = zip(gang.nodes, values, strict=True)
        return replace(gang, nodes=[replace(node, environment={**node.environment, **more}) for node, more in pairs])

    def check_secrets(self, names: Iterable[str], containers: Sequence[Mapping[str, Any]], queue: str) -> None:
        """Raises SecretsError where a job of this queue on one of these engines can't have the secrets that it requests."""
        if any(self._traits(name).secrets is not SecretValues.REFERENCES for name in names):
            self.secrets.check(containers, queue)

    def without_images(self, names: Iterable[str]) -> Sequence[str]:
        """Those of these engines that do not run a job's image."""
        return [name for name in names if not self._traits(name).images]

    def launch(self, gang: str, hosts: Sequence[str], plan: Callable[[], Plan[Any]], again: bool = True) -> str:
        """The handle of a gang, as text, once it is started; does not wait. Raises NotYet until then, and EngineError.

        Args:
            gang: Its name.
            hosts: Where its nodes are placed.
            plan: Makes its plan, where it has not been handed to the engine yet.
            again: Whether to try again where the last try has left nothing.
        """
        return self._runner(engine_of(hosts[0])).launch(gang, plan, again).text()

    def launch_pause(self, gang: str, host: str) -> float:
        """Seconds until the launch of a gang may be tried again; infinity while it is under way."""
        runner = self._runners.get(engine_of(host))
        return inf if runner is None else runner.launch_pause(gang)

    def observe(self, handle: str) -> GangStatus | None:
        """The newest status of a gang; None before the first. Does not wait, and raises nothing.

        Of a gang whose engine is not served, or can't look now, nothing new is known: it counts as running.
        """
        found = self._handle(handle)
        if runner := self._runners.get(found.engine):
            return runner.observe(found)
        return [NodeStatus(NodePhase.UNREACHABLE, words=_not_served(found.engine))] * found.nodes

    def poll(self) -> None:
        """Ask for newer statuses of the gangs that are observed; :attr:`changed` tells of those that differ. Does not wait."""
        for runner in self._runners.values():
            runner.poll()

    def status_age(self, handle: str) -> float | None:
        """Seconds since the engine was asked for the status that :meth:`observe` returns; None where it does not answer now."""
        found = self._handle(handle)
        return self._runner(found.engine).status_age(found) if found.engine in self._runners else None

    def stop(self, handle: str, grace: float) -> GangStatus:
        """Stop the gang, which may take long; returns how its nodes ended. Raises EngineError."""
        found = read_handle(handle)
        return self._runner(found.engine).stop(found, grace)

    def forget(self, host: str, gang: str, handle: str | None) -> None:
        """The gang, one of whose nodes was placed on ``host``, is over; ``handle``: None where it was never launched."""
        if handle is not None:
            self._handles.pop(handle, None)
        if runner := self._runners.get(engine_of(host)):
            runner.forget(gang, read_handle(handle) if handle else None)

    def _handle(self, text: str) -> Handle:
        """Read once: every look at a gang asks for it."""
        if (found := self._handles.get(text)) is None:
            found = self._handles[text] = read_handle(text)
        return found

    def _traits(self, name: str) -> Traits:
        """Those of an engine, also of one that is not served."""
        return self.engines[name].traits if name in self.engines else traits_of(name)

    def _runner(self, name: str) -> Runner:
        try:
            return self._runners[name]
        except KeyError:
            raise NotYet(_not_served(name), unknown=True) from None  # something of the gang may run there


def _has_secrets(gang: Gang) -> bool:
    return any(node.container.get("secrets") for node in gang.nodes)


def _not_served(name: str) -> str:
    return f"engine {name} is not served now; start muster serve with --engine {name}"
