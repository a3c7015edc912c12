"""The Python of a page, as its reader would save it: all blocks, one after the other, are one module."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

from tests.conftest import REPOSITORY


def blocks(page: str, language: str = "python") -> list[str]:
    """The blocks of Python on a page of ``docs/``."""
    text = (REPOSITORY / "docs" / page).read_text()
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def module(page: str, folder: Path, language: str = "python") -> ModuleType:
    """The page's blocks as an imported module; Warp reads its functions' source from the file.

    A test that a page shows is a file of its own.
    """
    name = f"page_{Path(page).stem.replace('-', '_')}"
    path = folder / f"{name}.py"
    path.write_text("\n\n".join(block for block in blocks(page, language) if "def test_" not in block))
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made
