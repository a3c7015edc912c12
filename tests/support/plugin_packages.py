"""Packages with a plug-in, as an installation leaves them: a module and the metadata beside it."""

from __future__ import annotations

from pathlib import Path

IMPORTS = "from shared_store.contract.plugins import Command, JobSection, Plugin\n"


def write_package(
    folder: Path, name: str, declaration: str, code: str = "", *, module: str = "", group: str = "muster.plugins"
) -> None:
    """Write the package ``name`` into a folder of the path.

    Args:
        folder: On the path.
        name: Of the package, and of the plug-in.
        declaration: What follows ``PLUGIN = `` in its module.
        code: Of its module ``<module>_parts``, which has the parts.
        module: Of the declaration; by default the package's name.
        group: Of its entry point.
    """
    module = module or name
    about = folder / f"{name}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[{group}]\n# a comment = x\n{name} = {module}:PLUGIN\n")
    (folder / f"{module}.py").write_text(f"{IMPORTS}PLUGIN = {declaration}\n")
    (folder / f"{module}_parts.py").write_text(code)
