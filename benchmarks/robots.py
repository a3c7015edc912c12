"""Public robot files as Muster loads them, beside MuJoCo's own reading: ``python -m benchmarks.robots`` writes ``robots.md``.

For each file of the packages below:

(a) whether every compared value of the model is the file's, within 1e-6 of the greater one;
(b) the greatest difference of a coordinate in one second of MuJoCo's C engine, with the file's own integrator, under fixed controls,
    without contacts and noslip; a robot that these leave at rest begins with a small random velocity of each joint;
(c) the same of Muster's own step, in float32 on the processor, at the end of that second.

Where (b) is greater than its limit, the table also has *float32*: the greatest difference of the file's model from four copies of
it, in which each value differs by up to one unit in the last place of a float32, which is how Newton holds values.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
import subprocess
import sys
import warnings
import zipfile
from importlib import util
from pathlib import Path
from typing import Any

import mujoco
import newton
import numpy as np
import warp as wp

from worker.simulation.robot_elements import empty_builder
from worker.simulation.robot_twins import Twins
from worker.simulation.robot_values import UNLIMITED, freedoms, without_contacts
from worker.simulation.worlds import Worlds
from worker.tasks import EffortActuator, Robot

PACKAGES = {
    "gymnasium": ("1.4.0", "envs/mujoco/assets", "*.xml"),
    "dm_control": ("1.0.50", "suite", "*.xml"),
    "gymnasium_robotics": ("1.4.2", "envs/assets", "*/*.xml"),
    "robosuite": ("1.5.2", "models/assets", "robots/*/robot.xml grippers/*.xml"),
    "mjlab": ("1.6.0", "", "asset_zoo/robots/*/xmls/*.xml tasks/cartpole/*.xml"),
    "mujoco_warp": ("3.17.0", "test_data", "*.xml actuation/*.xml tendon/*.xml humanoid/*.xml jdotv/*.xml"),
    "newton": ("1.8.0", "examples/assets", "nv_*.xml *.urdf"),
}
"""Version, folder and files of each package."""
PARTS = (
    "adroit_assets",
    "adroit_model",
    "shared",
    "base",
    "fetch/robot.xml",
    "hand/robot",
    "ray.xml",
    "collision.xml",
    "primitives.xml",
)
"""Files that are parts of others, or hold no robot."""
HELD = ("body", "jnt", "dof", "geom", "site", "tendon", "wrap", "eq", "actuator", "qpos0")
"""Kinds of a model's values that Newton holds in float32."""
ULP = 2.0**-23
UNSTABLE = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
EXACT, OWN = 1e-5, 1e-3
"""Limits of (b) and (c) [m, rad]."""
OUT = Path(__file__).with_suffix(".md")


@dataclasses.dataclass
class Row:
    """One file. Differences are in metres or radians, relative for greater coordinates than 1; None where nothing is compared."""

    file: str
    state: str
    detail: str = ""
    freedoms: int = 0
    engine: float | None = None
    own: float | None = None
    float32: float | None = None
    seconds: float = 1.0


def folder(package: str, build: Path) -> Path:
    """Where a package's files are: installed, or its wheel unpacked."""
    version, inside, _ = PACKAGES[package]
    found = util.find_spec(package)
    if found is not None and found.submodule_search_locations:
        return Path(found.submodule_search_locations[0]) / inside
    place = build / package
    if not place.is_dir():
        pip = [
            sys.executable,
            "-m",
            "pip",
            "download",
            "--quiet",
            "--no-deps",
            "--dest",
            str(build),
            f"{package}=={version}",
        ]
        subprocess.run(pip, check=True)
        with zipfile.ZipFile(next(build.glob(f"{package}-{version}-*.whl"))) as wheel:
            wheel.extractall(place)
    return place / package / inside


def files(build: Path) -> list[tuple[str, Path]]:
    """Shown name and path of each file."""
    found = []
    for package, (_, _, patterns) in PACKAGES.items():
        base = folder(package, build)
        paths = sorted(path for pattern in patterns.split() for path in base.glob(pattern))
        found += [
            (f"{package}: {path.relative_to(base)}", path)
            for path in paths
            if not any(part in str(path.relative_to(base)) for part in PARTS)
        ]
    return found


def measure(name: str, path: Path) -> Row:
    robot = Robot(path, passive=True)
    try:
        reading = robot.read()
    except ValueError as error:
        return Row(
            name, "refused", str(error).replace(str(path), path.name).removeprefix("robot: ").partition("; change")[0]
        )
    state = "corrected" if reading.corrected else "as it is"
    twins = Twins(reading.reference.model, reading.builder)
    existing, here = twins.free_of_contacts()
    row = Row(name, state, _short("".join(map(str, reading.corrected[:1])), path), existing.nv)
    if not existing.nv:
        row.detail = "nothing of it moves"
        return row
    here.opt.gravity = twins.built.opt.gravity
    controls = np.random.default_rng(1).uniform(-0.3, 0.3, existing.nu)
    first, second = mujoco.MjData(existing), mujoco.MjData(here)
    if np.abs(second_of(existing, first, controls)[-1] - first.qpos).max() < 1e-9:
        speeds = np.random.default_rng(2).uniform(-0.2, 0.2, existing.njnt)
        for joint, twin in twins.joints.items():
            if freedoms(existing, joint) == 1:
                first.qvel[existing.jnt_dofadr[joint]] = second.qvel[here.jnt_dofadr[twin]] = speeds[joint]
    columns = twins.columns()
    path_to, path_here = second_of(existing, first, controls), second_of(here, second, controls)
    row.seconds = len(path_to) / steps_of(existing)
    if row.seconds < 1.0:
        row.detail = f"{row.detail}; it grows without bound, compared for {row.seconds:.2g} s".strip("; ")
    row.engine = difference(path_to[:, columns[0]], path_here[:, columns[1]])
    if not row.engine <= EXACT:
        row.float32 = max(
            difference(path_to, second_of(disturbed(existing, seed), first, controls)) for seed in range(4)
        )
    try:
        last = in_muster(robot, twins, existing, second.qvel, controls)
        if row.seconds == 1.0:
            row.own = difference(path_to[-1, columns[0]], last[columns[1]])
    except (ValueError, NotImplementedError) as error:
        row.detail = f"{row.detail}; not stepped by Muster: {error}".strip("; ")
    return row


def _short(text: object, path: Path) -> str:
    """A sentence for the table, without the folder of the file and what to do."""
    return re.split(r"[;.] (?:change|Change|Give|Declare|Leave)", str(text).replace(str(path), path.name))[0]


def second_of(model: Any, begin: Any, controls: Any) -> Any:
    """The coordinates of one second in MuJoCo's C engine from ``begin`` on, shape ``(steps, nq)``, float64.

    It ends where a joint's force passes Newton's limit, or where MuJoCo finds the simulation unstable and would begin anew.
    """
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = begin.qpos, begin.qvel, controls
    path = np.empty((steps_of(model), model.nq))
    for step in range(len(path)):
        mujoco.mj_step(model, data)
        unlimited = float(np.abs(data.qfrc_actuator).max(initial=0.0)) < UNLIMITED
        if not unlimited or any(data.warning[kind].number for kind in UNSTABLE):
            return path[:step]
        path[step] = data.qpos
    return path


def difference(first: Any, second: Any) -> float:
    """The greatest difference of two paths, as far as both go, divided by the first where that is greater than 1; infinite for NaN."""
    both = list(zip(first, second, strict=False))
    differences = [np.abs(one - other) / np.maximum(1.0, np.abs(one)) for one, other in both]
    return float(np.nan_to_num(differences, nan=np.inf).max(initial=0.0))


def disturbed(model: Any, seed: int) -> Any:
    """Copy a model without contacts, and change each of its values by a random share of up to :data:`ULP`."""
    random, other = np.random.default_rng(seed), without_contacts(model)
    for name in dir(other):
        array = getattr(other, name) if name.partition("_")[0] in HELD else None
        if isinstance(array, np.ndarray) and array.dtype == np.float64:
            array *= 1.0 + ULP * random.uniform(-1.0, 1.0, array.shape)
    return other


def in_muster(robot: Robot, twins: Twins, existing: Any, speeds: Any, controls: Any) -> Any:
    """From the velocities ``speeds`` of the built model on, the coordinates after one second in Muster's own worlds, in the built model's order, shape ``(nq,)``, float32."""
    builder = empty_builder()
    if not existing.nu:
        robot = dataclasses.replace(robot, actuators=(EffortActuator("*"),))
    robot.add_to(builder)
    for joint, dof in enumerate(twins.dofs):
        if freedoms(twins.built, joint) == 1:
            builder.joint_qd[dof] = float(speeds[twins.built.jnt_dofadr[joint]])
    options = {"disable_contacts": True, "integrator": int(existing.opt.integrator), "njmax": 400}
    worlds = Worlds(
        builder,
        1,
        "cpu",
        timestep=existing.opt.timestep,
        substeps=steps_of(existing),
        fastest=1e9,
        solver_options=options,
    )
    worlds.restore_defaults()
    if existing.nu:
        worlds.arrays.controls.assign(controls[None].astype(np.float32))
    worlds.simulate()
    return worlds.solver.mjw_data.qpos.numpy()[0]


def steps_of(model: Any) -> int:
    return round(1.0 / float(model.opt.timestep))


def page(rows: list[Row]) -> str:
    moving = [row for row in rows if row.engine is not None and row.seconds == 1.0]
    equal = [row for row in moving if row.engine is not None and row.engine <= EXACT]
    own = [row for row in equal if row.own is not None and row.own <= OWN]
    lines = [
        "# Robot files",
        "",
        f"`python -m benchmarks.robots`: {len(rows)} public files; MuJoCo {mujoco.__version__}, Newton {newton.__version__}. "
        f"{len(equal)} are equal in every compared value of the model (within 1e-6) and move equally in MuJoCo's C engine for a "
        f"second (within {EXACT:g}); {len(own)} of them move equally in Muster's own float32 step, too (within {OWN:g}). "
        f"{sum(row.state == 'refused' for row in rows)} are refused by name. Of {sum(row.engine is None for row in rows if row.state != 'refused')} "
        f"nothing moves, and {sum(row.seconds < 1.0 for row in rows)} move without bound. The other {len(moving) - len(equal)} have equal "
        f"values, too, but move further apart than {EXACT:g} in the C engine.",
        "",
        "Why these do: their motion enlarges the rounding of values, which Newton holds in float32. *float32* is "
        "the greatest difference of the file's own model from four copies with values that differ by up to 1.2e-7 of themselves.",
        "",
        "Versions of the packages: " + ", ".join(f"{name} {version}" for name, (version, *_) in PACKAGES.items()) + ".",
        "",
        "| file | read | freedoms | C engine | float32 | own step | the first that Newton's importer reads otherwise, or why it is refused |",
        "|---|---|--:|--:|--:|--:|---|",
    ]
    for row in rows:
        numbers = ["" if value is None else f"{value:.1e}" for value in (row.engine, row.float32, row.own)]
        lines.append(
            f"| {row.file} | {row.state} | {row.freedoms or ''} | {' | '.join(numbers)} | {row.detail.replace('|', '/')} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--build", type=Path, default=Path("build/robots"), help="where wheels and rows are kept")
    parser.add_argument("--only", default="", help="files with this in their names")
    arguments = parser.parse_args()
    arguments.build.mkdir(parents=True, exist_ok=True)
    wp.config.log_level = wp.LOG_ERROR
    warnings.simplefilter("ignore")
    reading = ["git", "rev-parse", "--short", "HEAD:worker/simulation"]  # other code reads files otherwise
    revision = subprocess.run(reading, capture_output=True, text=True, check=True, cwd=OUT.parent.parent).stdout.strip()
    kept = arguments.build / f"rows-{revision}.json"
    rows = {row["file"]: Row(**row) for row in json.loads(kept.read_text())} if kept.is_file() else {}
    for name, path in files(arguments.build):
        if arguments.only in name and name not in rows:
            rows[name] = measure(name, path)
            print(rows[name], flush=True)
            kept.write_text(json.dumps([dataclasses.asdict(row) for row in rows.values()]))
    OUT.write_text(page(list(rows.values())))
    print(f"wrote {OUT}")


if __name__ == "__main__":
    main()
