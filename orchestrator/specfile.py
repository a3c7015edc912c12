"""Reading a spec from a YAML file, remembering on which line each key stands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from orchestrator.spec import Spec, SpecError, override, validate

Path_ = tuple[str | int, ...]


def load(path: str, assignments: list[str] | None = None) -> Spec:
    """The spec in the file ``path`` with ``--set`` assignments applied.

    Raises:
        SpecError: The file can't be read, is not YAML, or is not a valid spec; one line with file, line and key.
    """
    document, lines = read(path)
    if assignments and isinstance(document, dict):
        document = override(document, assignments)
    return validate(document, path, lines)


def read(path: str) -> tuple[Any, dict[Path_, int]]:
    """The document of a YAML file, and the line of each key path. Raises SpecError."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise SpecError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise SpecError(f"{path}: not a text file (UTF-8)") from None
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        lines: dict[Path_, int] = {}
        if node is not None:
            _note_lines(node, (), lines, path)
        return yaml.safe_load(text), lines
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise SpecError(f"{path}:{line}: not valid YAML: {error.problem}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise SpecError(f"{path}: not valid YAML: {str(error).splitlines()[0]}") from None


def _note_lines(node: yaml.Node, path: Path_, lines: dict[Path_, int], source: str) -> None:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            here = (*path, str(key.value))
            line = key.start_mark.line + 1
            if here in lines:
                raise SpecError(
                    f"{source}:{line}: {'.'.join(map(str, here))}: given twice, first on line {lines[here]}"
                )
            lines[here] = line
            _note_lines(value, here, lines, source)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            lines[(*path, index)] = value.start_mark.line + 1
            _note_lines(value, (*path, index), lines, source)
