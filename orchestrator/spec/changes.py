"""Changes of a job YAML from the command line: ``--set KEY=VALUE``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from orchestrator.domain.errors import SpecError
from orchestrator.domain.excerpts import excerpt

LONGEST_CHANGES = 24 << 10
"""Limit of characters of all ``--set`` assignments together: that of a job definition."""


def override(document: Mapping[str, Any], assignments: Sequence[str]) -> dict[str, Any]:
    """The document with ``key.path=value`` assignments applied (values are read as YAML). Raises SpecError."""
    import copy

    from orchestrator.spec import strict_yaml  # PyYAML takes a while to import, and most commands need none

    size = sum(map(len, assignments))
    if size > LONGEST_CHANGES:
        raise SpecError(f"--set: {size} characters of changes; at most {LONGEST_CHANGES}")
    result = copy.deepcopy(dict(document))
    for assignment in assignments:
        key, sign, text = assignment.partition("=")
        named = f"--set {excerpt(assignment, 100)}"
        if not sign or not all(key.split(".")):
            raise SpecError(f"{named}: expected KEY=VALUE, such as train.iterations=600")
        try:
            value, _ = strict_yaml.load(text)
        except strict_yaml.YamlError as error:
            where = f"line {error.line or 1}, {'.'.join(filter(None, (excerpt(key, 60), error.key)))}"
            raise SpecError(f"{named}: the value is not valid YAML ({where}): {error}") from None
        *parents, last = key.split(".")
        if len(parents) > strict_yaml.DEEPEST:
            raise SpecError(f"{named}: the key has {len(parents) + 1} levels; at most {strict_yaml.DEEPEST}")
        section: Any = result
        for parent in parents:
            section = section.setdefault(parent, {})
            if not isinstance(section, dict):
                raise SpecError(f"{named}: {excerpt(parent, 60)} is not a section")
        section[last] = value
    return result
