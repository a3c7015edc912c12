"""MuJoCo's compiled model written as MJCF in which every value is explicit.

Newton's importer reads such a file without having to know MuJoCo's defaults, its classes, its macros or its compiler. Source of the
elements and of their meaning: MuJoCo's XML reference.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from worker.simulation.robot_elements import (
    CARRIER,
    CARRIER_INERTIA,
    CARRIER_MASS,
    TARGETS,
    Words,
    actuator_ends,
    effective_geoms,
    equality_ends,
    held,
    quaternion,
    unique_names,
)

Element = ElementTree.Element
_WORDS = {
    "geom": Words(mujoco.mjtGeom, "plane hfield sphere capsule ellipsoid cylinder box mesh"),
    "joint": Words(mujoco.mjtJoint, "free ball slide hinge"),
    "wrap": Words(mujoco.mjtWrap, "joint pulley site sphere cylinder"),
    "equality": Words(mujoco.mjtEq, "connect weld joint tendon"),
    "trntype": Words(mujoco.mjtTrn, "joint jointinparent slidercrank tendon site body"),
    "dyntype": Words(mujoco.mjtDyn, "none integrator filter filterexact muscle user"),
    "gaintype": Words(mujoco.mjtGain, "fixed affine muscle user"),
    "biastype": Words(mujoco.mjtBias, "none affine muscle user"),
    "integrator": Words(mujoco.mjtIntegrator, "Euler RK4 implicit implicitfast"),
    "cone": Words(mujoco.mjtCone, "pyramidal elliptic"),
}
_OPTIONS = "wind density viscosity impratio tolerance ls_tolerance iterations ls_iterations"
_BODY = "pos=ipos quat=iquat mass diaginertia=inertia"
_JOINT = (
    "pos limited range margin stiffness solreflimit=solref solimplimit=solimp actuatorgravcomp=actgravcomp "
    "actuatorfrclimited=actfrclimited"
)
_DOF = "damping armature frictionloss solreffriction=solref solimpfriction=solimp"
_GEOM = "pos quat contype conaffinity condim group priority friction solmix solref solimp margin gap"
_PAIR = "condim=dim friction solref solreffriction solimp margin gap"
_TENDON = (
    "limited range actuatorfrclimited=actfrclimited actuatorfrcrange=actfrcrange margin stiffness damping armature frictionloss "
    "springlength=lengthspring solreflimit=solref_lim solimplimit=solimp_lim solreffriction=solref_fri solimpfriction=solimp_fri"
)
_ACTUATOR = (
    "gear dynprm gainprm biasprm lengthrange actearly ctrllimited ctrlrange forcelimited forcerange actlimited actrange"
)
"""Attributes of MJCF, and the fields of ``mujoco.MjModel`` without their prefixes where those have other names."""
_FLAGS = ("limited", "gravcomp", "actearly", "active")
"""Ends of the names of attributes that are true or false."""


def write(model: Any, *, named: Collection[str] = (), visuals: bool = True) -> str:
    """Write a compiled model as MJCF.

    Of several joints of a body all but the last move carriers (:data:`worker.simulation.robot_elements.CARRIER`), so that each keeps its own place,
    its order and its part in a tendon.

    Args:
        model: The compiled model, ``mujoco.MjModel``.
        named: Which of ``integrator`` and ``multiccd`` the file sets. Of others the compiled model has MuJoCo's defaults, and the
            worlds' defaults hold.
        visuals: Whether geoms that are only seen are written.

    Returns:
        The XML. Angles are in radians, and each number is written with all its digits.

    Raises:
        ValueError: An element is of a kind that Newton's models don't have.
    """
    return _Writer(model, named, visuals).write()


class _Writer:
    def __init__(self, model: Any, named: Collection[str], visuals: bool) -> None:
        self.model = model
        self.named = named
        self.geoms = range(model.ngeom) if visuals else effective_geoms(model)
        self.bodies: dict[int, Element] = {}
        self.names: dict[str, list[str]] = {}

    def name(self, kind: str, index: int) -> str:
        if kind not in self.names:
            self.names[kind] = unique_names(self.model, kind)
        return self.names[kind][int(index)]

    def word(self, words: str, values: Any, kind: str, index: int) -> str:
        """The word for the value of an element of some kind."""
        return _WORDS[words].of(values[index], f"{kind} {self.name(kind, index)}")

    def values(self, prefix: str, index: int, names: str) -> dict[str, Any]:
        """Attributes of an element, as of :data:`_GEOM`."""
        pairs = [(name, field or name) for name, _, field in (each.partition("=") for each in names.split())]
        found = {name: getattr(self.model, f"{prefix}_{field}")[index] for name, field in pairs}
        return {name: bool(value) if name.endswith(_FLAGS) else value for name, value in found.items()}

    def write(self) -> str:
        root = Element("mujoco", model="robot")
        _add(root, "compiler", angle="radian", autolimits="false", inertiafromgeom="false", balanceinertia="true")
        self._write_options(root)
        asset = _add(root, "asset")
        meshes = [geom for geom in self.geoms if self.model.geom_type[geom] == int(mujoco.mjtGeom.mjGEOM_MESH)]
        for mesh in np.unique(self.model.geom_dataid[meshes]):
            self._write_mesh(asset, mesh)
        for hfield in range(self.model.nhfield):
            self._write_hfield(asset, hfield)
        self.bodies[0] = _add(root, "worldbody")
        for body in range(1, self.model.nbody):
            self._write_body(body)
        for geom in self.geoms:
            self._write_geom(geom)
        for site in range(self.model.nsite):
            self._write_site(site)
        self._write_contacts(_add(root, "contact"))
        tendons, equalities, actuators = (_add(root, tag) for tag in ("tendon", "equality", "actuator"))
        for tendon in range(self.model.ntendon):
            self._write_tendon(tendons, tendon)
        for equality in range(self.model.neq):
            self._write_equality(equalities, equality)
        for actuator in range(self.model.nu):
            self._write_actuator(actuators, actuator)
        return ElementTree.tostring(root, encoding="unicode")

    def _write_options(self, root: Element) -> None:
        options = self.model.opt
        values = {name: getattr(options, name) for name in _OPTIONS.split()}
        values["cone"] = _WORDS["cone"].of(options.cone, "option")
        if "integrator" in self.named:
            values["integrator"] = _WORDS["integrator"].of(options.integrator, "option")
        if options.solver == int(mujoco.mjtSolver.mjSOL_CG):
            values["solver"] = "CG"
        element = _add(root, "option", **values)
        flags = {}
        for kind, bits, off in (
            (mujoco.mjtDisableBit, options.disableflags, "disable"),
            (mujoco.mjtEnableBit, options.enableflags, "enable"),
        ):
            for bit in kind.__members__.values():
                if int(bits) & int(bit) and not bit.name.startswith("mjN"):
                    flags[bit.name.partition("_")[2].lower()] = off
        for name in ("sleep", "gravity", "multiccd"):
            flags.pop(name, None)
        if "multiccd" in self.named:
            flags["multiccd"] = "enable"
        _add(element, "flag", **flags)

    def _write_mesh(self, asset: Element, mesh: int) -> None:
        model = self.model
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        vertex, triangles = model.mesh_vert[first : first + count], model.mesh_face[face : face + faces]
        _add(asset, "mesh", name=self.name("mesh", mesh), vertex=vertex.ravel(), face=triangles.ravel())

    def _write_hfield(self, asset: Element, hfield: int) -> None:
        model = self.model
        rows, columns, first = model.hfield_nrow[hfield], model.hfield_ncol[hfield], model.hfield_adr[hfield]
        data = model.hfield_data[first : first + rows * columns].reshape(rows, columns)
        size = {"size": model.hfield_size[hfield], "nrow": rows, "ncol": columns}
        elevation = data[::-1].ravel()  # the text begins with the last row
        _add(asset, "hfield", name=self.name("hfield", hfield), elevation=elevation, **size)

    def _write_body(self, body: int) -> None:
        model = self.model
        parent = self.bodies[int(model.body_parentid[body])]
        name = self.name("body", body)
        place: dict[str, Any] = {"pos": model.body_pos[body], "quat": model.body_quat[body]}
        joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        for index, joint in enumerate(joints[:-1]):
            parent = _add(parent, "body", name=f"{name}{CARRIER}{index}", **place)
            _add(parent, "inertial", pos=(0, 0, 0), mass=CARRIER_MASS, diaginertia=(CARRIER_INERTIA,) * 3)
            self._write_joint(parent, joint)
            place = {}
        if model.body_mocapid[body] >= 0:
            place["mocap"] = "true"
        element = self.bodies[body] = _add(parent, "body", name=name, gravcomp=model.body_gravcomp[body], **place)
        if model.body_mass[body] > 0:
            _add(element, "inertial", **self.values("body", body, _BODY))
        for joint in joints[-1:]:
            self._write_joint(element, joint)

    def _write_joint(self, element: Element, joint: int) -> None:
        model = self.model
        name, kind = self.name("joint", joint), self.word("joint", model.jnt_type, "joint", joint)
        if kind == "free":
            _add(element, "freejoint", name=name)
            return
        values = self.values("jnt", joint, _JOINT) | self.values("dof", model.jnt_dofadr[joint], _DOF)
        if kind != "ball":
            coordinate = model.jnt_qposadr[joint]
            values |= {"ref": model.qpos0[coordinate], "springref": model.qpos_spring[coordinate]}
            values["axis"] = model.jnt_axis[joint]
        if values["actuatorfrclimited"]:
            values["actuatorfrcrange"] = model.jnt_actfrcrange[joint]
        else:
            del values["actuatorfrclimited"]
        _add(element, "joint", name=name, type=kind, **values)

    def _write_geom(self, geom: int) -> None:
        model = self.model
        kind = self.word("geom", model.geom_type, "geom", geom)
        values = self.values("geom", geom, _GEOM) | {"size": model.geom_size[geom]}
        if kind in ("mesh", "hfield"):
            del values["size"]
            values[kind] = self.name(kind, model.geom_dataid[geom])
        material = model.geom_matid[geom]
        values["rgba"] = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        body = self.bodies[int(model.geom_bodyid[geom])]
        _add(body, "geom", name=self.name("geom", geom), type=kind, **values)

    def _write_site(self, site: int) -> None:
        kind = self.word("geom", self.model.site_type, "site", site)
        body = self.bodies[int(self.model.site_bodyid[site])]
        _add(body, "site", name=self.name("site", site), type=kind, **self.values("site", site, "size pos quat"))

    def _write_contacts(self, section: Element) -> None:
        model = self.model
        for pair in range(model.npair):
            geoms = {f"geom{end}": self.name("geom", getattr(model, f"pair_geom{end}")[pair]) for end in (1, 2)}
            _add(section, "pair", **geoms, **self.values("pair", pair, _PAIR))
        for signature in model.exclude_signature:
            self._exclude(section, int(signature) >> 16, int(signature) & 0xFFFF)
        for body in np.flatnonzero(model.body_jntnum > 1):
            self._exclude_parents(section, int(body))

    def _exclude_parents(self, section: Element, body: int) -> None:
        """Parents never touch children in MuJoCo: exclude those between which a carrier now stands."""
        weld = self.model.body_weldid
        parent = weld[self.model.body_parentid[weld[body]]]
        if parent and not self.model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
            for first in np.flatnonzero(weld == parent):
                for second in np.flatnonzero(weld == weld[body]):
                    self._exclude(section, int(first), int(second))

    def _exclude(self, section: Element, first: int, second: int) -> None:
        _add(section, "exclude", body1=self.name("body", first), body2=self.name("body", second))

    def _write_tendon(self, section: Element, tendon: int) -> None:
        model = self.model
        first, name = model.tendon_adr[tendon], self.name("tendon", tendon)
        kind = _WORDS["wrap"].of(model.wrap_type[first], f"tendon {name}")
        values = self.values("tendon", tendon, _TENDON)
        element = _add(section, "fixed" if kind == "joint" else "spatial", name=name, **values)
        for wrap in range(first, first + model.tendon_num[tendon]):
            self._write_wrap(element, wrap)

    def _write_wrap(self, element: Element, wrap: int) -> None:
        model = self.model
        kind = _WORDS["wrap"].of(model.wrap_type[wrap], "tendon")
        index, number = model.wrap_objid[wrap], model.wrap_prm[wrap]
        if kind == "joint":
            _add(element, "joint", joint=self.name("joint", index), coef=number)
        elif kind == "pulley":
            _add(element, "pulley", divisor=number)
        elif kind == "site":
            _add(element, "site", site=self.name("site", index))
        else:
            side = {"sidesite": self.name("site", number)} if number >= 0 else {}
            _add(element, "geom", geom=self.name("geom", index), **side)

    def _write_equality(self, section: Element, equality: int) -> None:
        model = self.model
        tag, values = self.word("equality", model.eq_type, "equality", equality), held(model, equality)
        if tag == "connect":
            values = {"anchor": values["anchor1"]}
        elif tag == "weld":  # one of sites, too: Newton's importer reads their bodies alone
            relpose = np.concatenate([values["anchor1"], quaternion(values["turn"])])
            values = {"anchor": values["anchor2"], "relpose": relpose, "torquescale": values["torquescale"]}
        for number, (kind, index) in enumerate(equality_ends(model, equality), 1):
            if index >= 0:
                values[f"{kind}{number}"] = self.name(kind, index)
        values |= self.values("eq", equality, "active=active0 solref solimp")
        _add(section, tag, name=self.name("equality", equality), **values)

    def _write_actuator(self, section: Element, actuator: int) -> None:
        model = self.model
        transmission = self.word("trntype", model.actuator_trntype, "actuator", actuator)
        values: dict[str, Any] = {
            word: self.name(*end)
            for word, end in zip(TARGETS[transmission], actuator_ends(model, actuator), strict=True)
            if end[1] >= 0
        }
        if transmission == "jointinparent":
            values = {transmission: values["joint"]}
        if transmission == "slidercrank":
            values["cranklength"] = model.actuator_cranklength[actuator]
        if model.actuator_actnum[actuator]:
            values["actdim"] = model.actuator_actnum[actuator]
        if transmission in ("joint", "jointinparent", "tendon"):
            values["damping"] = (model.actuator_damping[actuator], *model.actuator_dampingpoly[actuator])
            values["armature"] = model.actuator_armature[actuator]
        for kind in ("dyntype", "gaintype", "biastype"):
            values[kind] = self.word(kind, getattr(model, f"actuator_{kind}"), "actuator", actuator)
        values |= self.values("actuator", actuator, _ACTUATOR)
        _add(section, "general", name=self.name("actuator", actuator), **values)


def _add(parent: Element, tag: str, **values: Any) -> Element:
    return ElementTree.SubElement(parent, tag, {name: _text(value) for name, value in values.items()})


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return "true" if value else "false"
    return " ".join(
        repr(number.item() if isinstance(number, np.generic) else number) for number in np.atleast_1d(value)
    )
