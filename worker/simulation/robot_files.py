"""Robot files: location, format, and checks for missing parts before an importer reads them."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import newton.examples

from shared_store.contract.error_text import nearest
from worker.simulation.robot_elements import plain

FORMATS = {".xml": "", ".mjcf": "mjcf", ".urdf": "urdf", ".usd": "usd", ".usda": "usd", ".usdc": "usd", ".usdz": "usd"}
"""Format of a file by its ending, or of an ``.xml`` file by its first element."""

XACRO = "it has macros of xacro; expand it with xacro first: xacro FILE > robot.urdf"


@dataclass(frozen=True)
class RobotFile:
    """A file that an importer can read.

    Attributes:
        source: Path, or the XML itself.
        format: ``"mjcf"``, ``"urdf"`` or ``"usd"``.
        hinges: Names of several MJCF joints between one body and its parent, which Newton merges into one joint: by the name of that
            joint, in the order of its degrees of freedom.
        spec: The parsed MJCF, ``mujoco.MjSpec``; None for another format.
    """

    source: str
    format: str
    hinges: dict[str, list[str]] = field(default_factory=dict)
    spec: Any = None


def is_xml(source: str) -> bool:
    """Whether a source is the text of a file, and not its path."""
    return source.lstrip().startswith("<")


def read(file: str | Path) -> RobotFile:
    """Find and inspect a robot's file.

    Args:
        file: A path; ``"package:NAME/path"``, a file inside an installed Python package, which is not imported;
            ``"newton:NAME"``, one of Newton's own assets; or the text of an MJCF or URDF file.

    Raises:
        ValueError: The file, the package or the asset does not exist, the format is unknown, the XML can't be read, or a mesh that
            it names is missing.
    """
    text = str(file)
    if not text.strip():
        raise ValueError("a robot needs a file: a path, package:NAME/path, newton:NAME, or the text of one")
    if is_xml(text):
        source, shown, kind = text, "the robot's XML", _kind_of_xml(text, "the robot's XML")
    else:
        path, shown = _path(text), text
        source, ending = str(path), path.suffix.lower()
        if ending not in FORMATS:
            raise ValueError(
                f"{text}: a robot's file ends in {', '.join(FORMATS)}, not in {path.suffix or 'nothing'!r}"
            )
        kind = FORMATS[ending] or _kind_of_xml(_text_of(path, text), text)
    if kind == "mjcf":
        spec = parse_mjcf(source, shown)
        return RobotFile(source, kind, _hinges(spec), spec)
    if kind == "urdf":
        for mesh in urdf_root(source, shown).iter("mesh"):  # Newton would only warn and continue without them
            urdf_mesh(source, mesh.get("filename", ""), shown)
    return RobotFile(source, kind)


def _text_of(path: Path, shown: str) -> str:
    """The text of an XML file, in the encoding that it declares."""
    content = path.read_bytes()
    declared = re.match(rb"\s*<\?xml[^>]*encoding=[\"']([\w.-]+)", content)
    encoding = declared.group(1).decode() if declared else "utf-8-sig"
    try:
        return content.decode(encoding)
    except LookupError as error:
        raise ValueError(
            f"{shown}: the file declares the encoding {encoding}, which is unknown; write it in UTF-8"
        ) from error
    except UnicodeDecodeError as error:
        words = f"{encoding.removesuffix('-sig').upper()} ({error.reason} at byte {error.start})"
        raise ValueError(f"{shown}: the file is not text in {words}; declare its encoding in its first line") from error


def _path(file: str) -> Path:
    scheme, _, rest = file.partition(":")
    if scheme == "newton":
        return _in_folder(file, Path(newton.examples.get_asset_directory()), rest, "Newton's assets")
    if scheme == "package":
        package, _, inside = rest.partition("/")
        found = importlib.util.find_spec(package) if package.isidentifier() else None
        if found is None or not found.submodule_search_locations:
            known = [name for name in metadata.packages_distributions() if not name.startswith("_")]
            near = nearest(package, known, "install it in the workers' environment", cutoff=0.7)
            raise ValueError(f"{file}: there is no Python package {package!r}; {near}")
        folder = Path(next(iter(found.submodule_search_locations)))
        return _in_folder(file, folder, inside, f"the package {package}")
    path = Path(file).expanduser()
    if not path.parent.is_dir():
        raise ValueError(f"{file}: there is no folder {path.parent}; relative paths begin at {Path.cwd()}")
    return _in_folder(file, path.parent, path.name, str(path.parent.absolute()))


def _in_folder(file: str, folder: Path, name: str, where: str) -> Path:
    path = folder / name
    if path.is_file():
        return path
    if path.is_dir():
        raise ValueError(
            f"{file}: is a folder; name a robot's file in it ({', '.join(_files(path)) or 'none is there'})"
        )
    parent = path.parent
    if not parent.is_dir():
        whole = sorted(str(item.relative_to(folder)) for item in folder.rglob("*") if item.suffix in FORMATS)
        raise ValueError(
            f"{file}: there is no folder {parent.name!r} in {where}; {nearest(name, whole, 'look for it')}"
        )
    existing = _files(parent)
    hint = nearest(path.name, existing) if existing else f"no robot's file ({', '.join(FORMATS)}) is there"
    raise ValueError(f"{file}: there is no such file in {where}; {hint}")


def _files(folder: Path) -> list[str]:
    return sorted(item.name for item in folder.iterdir() if item.suffix.lower() in FORMATS and item.is_file())


def _kind_of_xml(text: str, shown: str) -> str:
    root = _root(text, shown).tag
    kinds = {"mujoco": "mjcf", "mujocoinclude": "mjcf", "robot": "urdf"}
    if root not in kinds:
        raise ValueError(f"{shown}: its first element is <{root}>; MJCF begins with <mujoco>, URDF with <robot>")
    return kinds[root]


def _root(text: str, shown: str) -> ElementTree.Element:
    try:
        return _element(text)
    except ElementTree.ParseError as error:
        if "unbound prefix" in str(error) and "<xacro:" in text:
            raise ValueError(f"{shown}: {XACRO}") from error
        raise ValueError(f"{shown}: is not XML: {error}") from error


def _element(text: str) -> ElementTree.Element:
    """The first element of XML, without its comments: MuJoCo reads those with dashes in them, too."""
    return ElementTree.fromstring(
        re.sub("<!--.*?-->", lambda found: "\n" * found[0].count("\n"), text, flags=re.DOTALL)
    )


def parse_mjcf(source: str, shown: str) -> Any:
    """Parse an MJCF file, or the text of an MJCF or URDF file, as ``mujoco.MjSpec``.

    Raises:
        ValueError: MuJoCo can't parse it.
    """
    is_text = is_xml(source)
    try:
        with quiet() as warned:
            spec = (mujoco.MjSpec.from_string if is_text else _spec_of_file)(source)
    except ValueError as error:
        raise ValueError(f"{shown}: {' '.join(str(error).split())}") from error
    if any("NaN" in text for text in warned):
        raise ValueError(f"{shown}: {_not_a_number(source)}; give it a number")
    return spec


def _spec_of_file(path: str) -> Any:
    """An MJCF file as MuJoCo parses it, which takes every text for UTF-8."""
    try:
        Path(path).read_bytes().decode("utf-8")
    except UnicodeDecodeError:
        spec = mujoco.MjSpec.from_string(_text_of(Path(path), path))
        spec.modelfiledir = str(Path(path).parent)
        return spec
    return mujoco.MjSpec.from_file(path)


def _not_a_number(source: str) -> str:
    for root, _ in mjcf_roots(source):
        parents = {child: parent for parent in root.iter() for child in parent}
        for element in root.iter():
            for name, value in element.attrib.items():
                if "nan" not in value.lower().split():
                    continue
                owner = element
                while not owner.get("name") and owner in parents:
                    owner = parents[owner]
                is_within = owner is not element and owner.get("name")
                within = f" in {owner.tag} {owner.get('name')}" if is_within else ""
                return f"{name}={value!r} of <{element.tag} name={element.get('name', '')!r}>{within} is not a number"
    return "a value of a model that it attaches is not a number"


def mjcf_roots(source: str) -> Iterator[tuple[ElementTree.Element, Path]]:
    """The first element of an MJCF file, or of the text of one, and of each file that it includes, with the folder of that file.

    MuJoCo looks for an included file in the folder of the first one, then in that of the file which includes it.
    """
    is_text = is_xml(source)
    first = Path() if is_text else Path(source).parent
    yield from _with_included(source if is_text else Path(source), first, first)


def _with_included(file: str | Path, first: Path, folder: Path) -> Iterator[tuple[ElementTree.Element, Path]]:
    text = file if isinstance(file, str) else _text_of(file, str(file))
    try:
        root = _element(text)
    except ElementTree.ParseError:  # of an included file, of which MuJoCo's parser accepts a little more
        return
    yield root, folder
    for name in (include.get("file", "") for include in root.iter("include")):
        place = next((base / name for base in (first, folder) if (base / name).is_file()), None)
        if place is not None:
            yield from _with_included(place, first, place.parent)


def named_options(file: RobotFile) -> set[str]:
    """Which of ``integrator`` and ``multiccd`` a file sets, or one that it includes.

    The parsed file does not show whether it names Euler's integrator, the default.
    """
    is_another = file.spec is not None and file.spec.option.integrator != mujoco.mjtIntegrator.mjINT_EULER
    named = {"integrator"} if is_another else set()
    for root, _ in mjcf_roots(file.source):
        named |= {"integrator" for option in root.iter("option") if option.get("integrator")}
        named |= {"multiccd" for flag in root.iter("flag") if flag.get("multiccd") == "enable"}
    return named


def asset_folders(source: str, kind: str) -> list[tuple[Path, str]]:
    """Where an MJCF file, or the text of one, and the models that it attaches look for assets of ``"meshdir"`` or ``"texturedir"``.

    Returns:
        Of each file: its folder, and the assets' folder inside of that as the file says it, the main file's first.
    """
    words: dict[str, str] = {}
    attached = []
    main = Path() if is_xml(source) else Path(source).parent
    for root, _ in mjcf_roots(source):
        for compiler in root.iter("compiler"):
            words |= compiler.attrib
        models = [main / model.get("file", "") for model in root.iter("model")]
        attached += [place for model in models if model.is_file() for place in asset_folders(str(model), kind)]
    return [(main, words.get(kind, words.get("assetdir", ""))), *attached]


def missing_asset(spec: Any, source: str, name: str, shown: str) -> ValueError:
    """The error of a mesh or height field that MuJoCo can't open, by its ``name`` in MuJoCo's message, with the folder of the assets."""
    places = [(folder, os.path.normpath(inside)) for folder, inside in asset_folders(source, "meshdir")]
    without = [(folder, inside) for folder, inside in places if not (folder / name).is_file()]
    within = [each for each in without if Path(name).is_relative_to(each[1])]
    folder, inside = max(within, key=lambda each: len(Path(each[1]).parts), default=(places[0][0], ""))
    fields = [Path(field.file).name for field in spec.hfields]
    place = Path(name).relative_to(inside) if within else Path(name)
    kind = "height field" if place.name in fields else "mesh"
    return _missing(shown, kind, str(place), (folder / inside / place).parent)


@contextlib.contextmanager
def quiet() -> Iterator[list[str]]:
    """Keep MuJoCo's parser and compiler and Newton's importers from printing, and yield what MuJoCo warns of."""
    warned: list[str] = []
    before, logger = mujoco.get_mju_user_warning(), logging.getLogger("newton")
    level = logger.level
    mujoco.set_mju_user_warning(warned.append)
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield warned
    finally:
        logger.setLevel(level)
        mujoco.set_mju_user_warning(before)


def urdf_root(source: str, shown: str) -> ElementTree.Element:
    """The ``<robot>`` of a URDF file or text. Raises ValueError where it has macros of xacro, which are not expanded."""
    root = _root(source if is_xml(source) else _text_of(Path(source), shown), shown)
    if any("xacro" in str(element.tag).rpartition("}")[0] for element in root.iter()):
        raise ValueError(f"{shown}: {XACRO}")
    return root


def urdf_mesh(source: str, name: str, shown: str) -> Path:
    """Find a mesh that a URDF file names: relative to the file, ``file://…`` or ``package://NAME/…``.

    Raises:
        ValueError: It is missing, or it can't be found.
    """
    if is_xml(source):
        raise ValueError(
            f"{shown}: its mesh {name} can only be found relative to a URDF file; give the path of that file"
        )
    folder = Path(source).resolve().parent
    scheme, is_uri, inside = name.partition("://")
    place = folder / name.removeprefix("file://")
    if scheme == "package" and is_uri:
        package = inside.partition("/")[0]
        above = next((base for base in (folder, *folder.parents) if base.name == package), None)
        if above is None:
            raise ValueError(
                f"{shown}: its mesh {name} is of the package {package}, but no folder above the file has that name"
            )
        place = above.parent / inside
    if not place.is_file():
        raise _missing(shown, "mesh", name, place.parent)
    return place


def _missing(shown: str, kind: str, name: str, folder: Path) -> ValueError:
    existing = sorted(item.name for item in folder.iterdir() if item.is_file()) if folder.is_dir() else []
    near = nearest(Path(name).name, existing, "put it there") if existing else "that folder does not exist or is empty"
    return ValueError(f"{shown}: its {kind} {name} is missing in {folder}; {near}")


def _hinges(spec: Any) -> dict[str, list[str]]:
    """Names of merged joints: Newton's joint has slides first, then hinges, and its name joins all their names."""
    hinges = {}
    one_dof = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    for body in spec.bodies:
        names = [
            (joint.type, plain(joint.name or f"{body.name}_joint_{index}")) for index, joint in enumerate(body.joints)
        ]
        if len(names) > 1 and all(kind in one_dof for kind, _ in names):
            slides = [name for kind, name in names if kind == one_dof[0]]
            hinges["_".join(name for _, name in names)] = slides + [name for kind, name in names if kind == one_dof[1]]
    return hinges
