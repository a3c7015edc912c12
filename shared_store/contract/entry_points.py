"""Entry points of installed packages that have one name and several meanings, so that none of them is chosen."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import EntryPoint


def clash(points: Iterable[EntryPoint], name: str, own: str = "") -> str | None:
    """Why a name has no meaning: the packages that give it different ones, as a line; None where there is one.

    Args:
        points: All entry points of a group.
        name: Of one of them.
        own: The ``module:name`` that Muster gives it; empty where Muster has its entry point among ``points``, or none.
    """
    packages: dict[str, str] = {}
    for point in points:
        if point.name == name:
            packages.setdefault(point.value, point.dist.name if point.dist else "a package without a name")
    if own and "muster" not in packages.values():
        packages.setdefault(own, "muster")
    if len(packages) < 2:
        return None
    both = " and ".join(f"the package {package} ({value})" for value, package in sorted(packages.items()))
    return f"the name {name} is given by {both}; remove one of them (pip uninstall)"
