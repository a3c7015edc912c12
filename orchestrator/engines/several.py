"""Several engines as one: what a controller drives. A host's name tells whose it is, and so does a gang's handle."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from orchestrator.engines.base import (
    Engine,
    EngineError,
    Gang,
    GangStatus,
    Host,
    NodeStatus,
    NotYet,
    Plan,
    engine_of,
)

log = logging.getLogger("muster.engines")


class NotServed(NotYet):
    """This controller was started without the engine, on which something of the gang may run."""

    def __init__(self, message: str) -> None:
        super().__init__(message, unknown=True)


class Several:
    """Engines by their names; the first is the one that jobs of the queue ``default`` go to."""

    def __init__(self, engines: Sequence[Engine]) -> None:
        self.engines: Mapping[str, Engine] = {engine.name: engine for engine in engines}
        self._known: dict[str, Sequence[Host]] = {}
        self._troubles: dict[str, str] = {}

    @property
    def names(self) -> Sequence[str]:
        return list(self.engines)

    @property
    def queueing(self) -> frozenset[str]:
        """Those that queue by themselves."""
        return frozenset(name for name, engine in self.engines.items() if engine.queues)

    def is_elastic(self, names: Iterable[str]) -> bool:
        """Whether one of these engines may have more hosts later."""
        return any(self.engines[name].elastic for name in names if name in self.engines)

    @property
    def addresses(self) -> Sequence[str]:
        """Of this machine as the engines' nodes see it, beside loopback."""
        return sorted({engine.address for engine in self.engines.values() if engine.address})

    def capacity(self, names: Iterable[str] | None = None) -> Sequence[Host]:
        """The hosts of all engines, or of these. Those of one that does not answer are as they were when it last did."""
        hosts: list[Host] = []
        for name in self.engines if names is None else names:
            try:
                self._known[name] = self.engines[name].capacity()
                self._troubles.pop(name, None)
            except EngineError as error:
                if self._troubles.get(name) != str(error):  # said once, not at every pass
                    log.warning("engine %s: %s", name, error)
                self._troubles[name] = str(error)
            hosts += self._known.get(name, [])
        return hosts

    def plan(self, gang: Gang) -> Plan:
        """As the engine plans it. Raises EngineError, also where an image is named that it would not run and must not pass over."""
        engine = self._engine(engine_of(gang.placements[0].host))
        named = {str(container.get("image") or "muster") for container in gang.containers} - {"muster"}
        if named and not engine.images and gang.options.get("images") == "refuse":
            raise EngineError(
                f"image {min(named)}: the {engine.name} engine runs commands in its nodes' own environment, and compute environment "
                f"{gang.pool} refuses other images (tag muster:images)"
            )
        if gang.bus and engine.address:
            gang = replace(gang, bus=f"tcp/{engine.address}:{gang.bus.rpartition(':')[2]}")
        return engine.plan(gang)

    def launch(self, plan: Plan) -> str:
        name = engine_of(plan.gang.placements[0].host)
        return f"{name} {len(plan.nodes)} {self._engine(name).launch(plan)}"

    def observe(self, handle: str) -> GangStatus:
        """Of a gang whose engine is not served now nothing is known: it counts as running."""
        name, count, rest = handle.split(" ", 2)
        try:
            return self._engine(name).observe(rest)
        except NotServed as error:
            return [NodeStatus(True, "", waiting=str(error))] * int(count)

    def stop(self, handle: str, grace: float) -> None:
        """As the engine does it. Raises EngineError where it can't, or is not served now."""
        name, _, rest = handle.split(" ", 2)
        self._engine(name).stop(rest, grace)

    def _engine(self, name: str) -> Engine:
        try:
            return self.engines[name]
        except KeyError:
            raise NotServed(f"engine {name} is not served now; start muster serve with --engine {name}") from None
