"""YAML as data: plain values only, no tags, and bounded depth and number of values, aliases written out.

PyYAML's own loader keeps an alias as a reference to one shared object. A few hundred bytes of aliases of aliases then stand
for gigabytes as soon as anything writes the value out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

MOST_CHARACTERS = 1 << 20
MOST_VALUES = 10_000
"""Scalars, lists and mappings of a document, with every alias counted as what it stands for."""
DEEPEST = 50
"""Levels of lists and mappings."""
MOST_BITS = 64
"""Of a whole number; JSON readers understand no longer ones."""

Path = tuple[str | int, ...]


class YamlError(ValueError):
    """Not YAML that is accepted; ``line`` (from 1, None where unknown) and ``key`` (dotted path, may be empty) say where."""

    def __init__(self, problem: str, line: int | None = None, path: Path = ()) -> None:
        super().__init__(problem)
        self.line, self.key = line, ".".join(map(str, path))[:200]


def load(text: str, *, aliases: bool = False) -> tuple[Any, Mapping[Path, int]]:
    """The document and the line of each key path.

    Args:
        text: One YAML document.
        aliases: Accept anchors and aliases, such as ``<<: *base``, as long as the document with them written out is within the
            limits. For files that their own reader wrote; never for what a request brings.

    Raises:
        YamlError: Not YAML, or beyond a limit.
    """
    if len(text) > MOST_CHARACTERS:
        raise YamlError(f"has {len(text)} characters; at most {MOST_CHARACTERS}")
    try:
        loader = _Loader(text, aliases)
        node = loader.get_single_node()
        if node is None:
            return None, {}
        _measure(node, {}, ())
        lines: dict[Path, int] = {}
        _note_lines(node, (), lines)
        return loader.construct_document(node), lines
    except yaml.MarkedYAMLError as error:
        raise YamlError(str(error.problem)[:200], error.problem_mark.line + 1 if error.problem_mark else 1) from None
    except YamlError:
        raise
    except (yaml.YAMLError, ValueError, AttributeError, RecursionError) as error:
        raise YamlError((str(error).splitlines() or ["a value can't be read"])[0][:200]) from None


class _Loader(yaml.SafeLoader):
    """Refuses while it reads, so that nothing larger than the limits is ever made."""

    def __init__(self, text: str, aliases: bool) -> None:
        super().__init__(text)
        self._aliases, self._count = aliases, 0
        self._path: list[str | int] = []

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        line = event.start_mark.line + 1
        key = index.value if isinstance(index, yaml.ScalarNode) else index if isinstance(index, int) else None
        path = (*self._path, key) if key is not None else tuple(self._path)
        if not self._aliases and (isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None)):
            sign = "*" if isinstance(event, yaml.AliasEvent) else "&"
            name = f"{sign}{event.anchor}"[:40]
            raise YamlError(f"anchors and aliases ({name}) are not accepted here; write the value out", line, path)
        self._count += 1
        if self._count > MOST_VALUES:
            raise YamlError(f"more than {MOST_VALUES} values", line, path)
        if len(path) > DEEPEST:
            raise YamlError(f"nested deeper than {DEEPEST} levels", line)
        if key is None:
            return super().compose_node(parent, index)
        self._path.append(key)
        try:
            return super().compose_node(parent, index)
        finally:
            self._path.pop()


def _whole(loader: yaml.SafeLoader, node: Any) -> int:
    value = loader.construct_yaml_int(node)
    if value.bit_length() > MOST_BITS:
        raise YamlError(f"a number of more than {MOST_BITS} bits", node.start_mark.line + 1)
    return value


def _refuse(loader: yaml.SafeLoader, node: yaml.Node) -> Any:
    raise YamlError(f"{node.tag.rpartition(':')[2]} is not a kind of value that JSON has", node.start_mark.line + 1)


_Loader.add_constructor("tag:yaml.org,2002:int", _whole)
for _tag in ("binary", "set", "omap", "pairs"):  # values that JSON, which carries the spec, does not have
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _refuse)


def _measure(node: yaml.Node, known: dict[int, tuple[int, int]], above: tuple[int, ...]) -> tuple[int, int]:
    """Numbers of values and of levels of a node with its aliases written out. Raises YamlError beyond the limits."""
    identity = id(node)
    if identity in known:
        return known[identity]
    line = node.start_mark.line + 1
    if identity in above:
        raise YamlError("an alias stands inside of what it stands for", line)
    inner: list[yaml.Node] = []
    if isinstance(node, yaml.MappingNode):
        inner = [each for pair in node.value for each in pair]
    elif isinstance(node, yaml.SequenceNode):
        inner = node.value
    count, depth = 1, 0
    for each in inner:
        values, levels = _measure(each, known, (*above, identity))
        count, depth = count + values, max(depth, levels + 1)
        if count > MOST_VALUES:
            raise YamlError(f"more than {MOST_VALUES} values with the aliases written out", line)
        if depth > DEEPEST:
            raise YamlError(f"nested deeper than {DEEPEST} levels", line)
    known[identity] = count, depth
    return count, depth


def _note_lines(node: yaml.Node, path: Path, lines: dict[Path, int]) -> None:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            here = (*path, str(key.value)[:200])
            line = key.start_mark.line + 1
            if here in lines:
                raise YamlError(f"given twice, first on line {lines[here]}", line, here)
            lines[here] = line
            _note_lines(value, here, lines)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            lines[(*path, index)] = value.start_mark.line + 1
            _note_lines(value, (*path, index), lines)
