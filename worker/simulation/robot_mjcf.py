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

from worker.simulation import carriers
from worker.simulation.robot_connections import TARGETS, actuator_ends, effective_geoms, equality_ends, held
from worker.simulation.robot_elements import Words, unique_names
from worker.simulation.robot_values import quaternion

Element = ElementTree.Element


_GEOM_TYPES = Words(mujoco.mjtGeom, "plane hfield sphere capsule ellipsoid cylinder box mesh")
_JOINT_TYPES = Words(mujoco.mjtJoint, "free ball slide hinge")
_WRAP_TYPES = Words(mujoco.mjtWrap, "joint pulley site sphere cylinder")
_EQUALITY_TYPES = Words(mujoco.mjtEq, "connect weld joint tendon")
_TRANSMISSIONS = Words(mujoco.mjtTrn, "joint jointinparent slidercrank tendon site body")
_DYNAMICS = Words(mujoco.mjtDyn, "none integrator filter filterexact muscle user")
_INTEGRATORS = Words(mujoco.mjtIntegrator, "Euler RK4 implicit implicitfast")
_CONES = Words(mujoco.mjtCone, "pyramidal elliptic")
_GAINS = Words(mujoco.mjtGain, "fixed affine muscle user")
_BIASES = Words(mujoco.mjtBias, "none affine muscle user")


def write(model: Any, *, named: Collection[str] = (), visuals: bool = True) -> str:
    """Write a compiled model as MJCF.

    Of several joints of a body all but the last move carriers (:mod:`worker.simulation.carriers`), so that each keeps its own place,
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

    def word(self, words: Words, values: Any, kind: str, index: int) -> str:
        """The word for the value of an element of some kind."""
        return words.of(values[index], f"{kind} {self.name(kind, index)}")

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
        chosen = {"integrator": _INTEGRATORS.of(options.integrator, "option")} if "integrator" in self.named else {}
        if options.solver == int(mujoco.mjtSolver.mjSOL_CG):
            chosen["solver"] = "CG"
        element = _add(
            root,
            "option",
            wind=options.wind,
            density=options.density,
            viscosity=options.viscosity,
            impratio=options.impratio,
            tolerance=options.tolerance,
            ls_tolerance=options.ls_tolerance,
            iterations=options.iterations,
            ls_iterations=options.ls_iterations,
            cone=_CONES.of(options.cone, "option"),
            **chosen,
        )
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
        _add(
            asset,
            "mesh",
            name=self.name("mesh", mesh),
            vertex=model.mesh_vert[first : first + count].ravel(),
            face=model.mesh_face[face : face + faces].ravel(),
        )

    def _write_hfield(self, asset: Element, hfield: int) -> None:
        model = self.model
        rows, columns, first = model.hfield_nrow[hfield], model.hfield_ncol[hfield], model.hfield_adr[hfield]
        data = model.hfield_data[first : first + rows * columns].reshape(rows, columns)
        _add(
            asset,
            "hfield",
            name=self.name("hfield", hfield),
            size=model.hfield_size[hfield],
            nrow=rows,
            ncol=columns,
            elevation=data[::-1].ravel(),  # the text begins with the last row
        )

    def _write_body(self, body: int) -> None:
        model = self.model
        parent = self.bodies[int(model.body_parentid[body])]
        name = self.name("body", body)
        place: dict[str, Any] = {"pos": model.body_pos[body], "quat": model.body_quat[body]}
        joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        for index, joint in enumerate(joints[:-1]):
            parent = _add(parent, "body", name=f"{name}{carriers.MARK}{index}", **place)
            _add(parent, "inertial", pos=(0, 0, 0), mass=carriers.MASS, diaginertia=(carriers.INERTIA,) * 3)
            self._write_joint(parent, joint)
            place = {}
        if model.body_mocapid[body] >= 0:
            place["mocap"] = "true"
        element = self.bodies[body] = _add(parent, "body", name=name, gravcomp=model.body_gravcomp[body], **place)
        if model.body_mass[body] > 0:
            _add(
                element,
                "inertial",
                pos=model.body_ipos[body],
                quat=model.body_iquat[body],
                mass=model.body_mass[body],
                diaginertia=model.body_inertia[body],
            )
        for joint in joints[-1:]:
            self._write_joint(element, joint)

    def _write_joint(self, element: Element, joint: int) -> None:
        model = self.model
        name, kind = self.name("joint", joint), self.word(_JOINT_TYPES, model.jnt_type, "joint", joint)
        if kind == "free":
            _add(element, "freejoint", name=name)
            return
        coordinate, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        values = {
            "pos": model.jnt_pos[joint],
            "limited": bool(model.jnt_limited[joint]),
            "range": model.jnt_range[joint],
            "margin": model.jnt_margin[joint],
            "stiffness": model.jnt_stiffness[joint],
            "damping": model.dof_damping[dof],
            "armature": model.dof_armature[dof],
            "frictionloss": model.dof_frictionloss[dof],
            "solreflimit": model.jnt_solref[joint],
            "solimplimit": model.jnt_solimp[joint],
            "solreffriction": model.dof_solref[dof],
            "solimpfriction": model.dof_solimp[dof],
            "actuatorgravcomp": bool(model.jnt_actgravcomp[joint]),
        }
        if kind != "ball":
            values["axis"] = model.jnt_axis[joint]
            values |= {"ref": model.qpos0[coordinate], "springref": model.qpos_spring[coordinate]}
        if model.jnt_actfrclimited[joint]:
            values |= {"actuatorfrclimited": True, "actuatorfrcrange": model.jnt_actfrcrange[joint]}
        _add(element, "joint", name=name, type=kind, **values)

    def _write_geom(self, geom: int) -> None:
        model = self.model
        kind = self.word(_GEOM_TYPES, model.geom_type, "geom", geom)
        values: dict[str, Any] = {"size": model.geom_size[geom]}
        if kind in ("mesh", "hfield"):
            values = {kind: self.name(kind, model.geom_dataid[geom])}
        material = model.geom_matid[geom]
        _add(
            self.bodies[int(model.geom_bodyid[geom])],
            "geom",
            name=self.name("geom", geom),
            type=kind,
            pos=model.geom_pos[geom],
            quat=model.geom_quat[geom],
            contype=model.geom_contype[geom],
            conaffinity=model.geom_conaffinity[geom],
            condim=model.geom_condim[geom],
            group=model.geom_group[geom],
            priority=model.geom_priority[geom],
            friction=model.geom_friction[geom],
            solmix=model.geom_solmix[geom],
            solref=model.geom_solref[geom],
            solimp=model.geom_solimp[geom],
            margin=model.geom_margin[geom],
            gap=model.geom_gap[geom],
            rgba=model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom],
            **values,
        )

    def _write_site(self, site: int) -> None:
        model = self.model
        kind = self.word(_GEOM_TYPES, model.site_type, "site", site)
        _add(
            self.bodies[int(model.site_bodyid[site])],
            "site",
            name=self.name("site", site),
            type=kind,
            size=model.site_size[site],
            pos=model.site_pos[site],
            quat=model.site_quat[site],
        )

    def _write_contacts(self, section: Element) -> None:
        model = self.model
        for pair in range(model.npair):
            _add(
                section,
                "pair",
                geom1=self.name("geom", model.pair_geom1[pair]),
                geom2=self.name("geom", model.pair_geom2[pair]),
                condim=model.pair_dim[pair],
                friction=model.pair_friction[pair],
                solref=model.pair_solref[pair],
                solreffriction=model.pair_solreffriction[pair],
                solimp=model.pair_solimp[pair],
                margin=model.pair_margin[pair],
                gap=model.pair_gap[pair],
            )
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
        first = model.tendon_adr[tendon]
        wraps = range(first, first + model.tendon_num[tendon])
        element = _add(
            section,
            "fixed"
            if _WRAP_TYPES.of(model.wrap_type[first], f"tendon {self.name('tendon', tendon)}") == "joint"
            else "spatial",
            name=self.name("tendon", tendon),
            limited=bool(model.tendon_limited[tendon]),
            range=model.tendon_range[tendon],
            actuatorfrclimited=bool(model.tendon_actfrclimited[tendon]),
            actuatorfrcrange=model.tendon_actfrcrange[tendon],
            margin=model.tendon_margin[tendon],
            stiffness=model.tendon_stiffness[tendon],
            damping=model.tendon_damping[tendon],
            armature=model.tendon_armature[tendon],
            frictionloss=model.tendon_frictionloss[tendon],
            springlength=model.tendon_lengthspring[tendon],
            solreflimit=model.tendon_solref_lim[tendon],
            solimplimit=model.tendon_solimp_lim[tendon],
            solreffriction=model.tendon_solref_fri[tendon],
            solimpfriction=model.tendon_solimp_fri[tendon],
        )
        for wrap in wraps:
            self._write_wrap(element, wrap)

    def _write_wrap(self, element: Element, wrap: int) -> None:
        model = self.model
        kind = _WRAP_TYPES.of(model.wrap_type[wrap], "tendon")
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
        tag, values = self.word(_EQUALITY_TYPES, model.eq_type, "equality", equality), held(model, equality)
        if tag == "connect":
            values = {"anchor": values["anchor1"]}
        elif tag == "weld":  # one of sites, too: Newton's importer reads their bodies alone
            relpose = np.concatenate([values["anchor1"], quaternion(values["turn"])])
            values = {"anchor": values["anchor2"], "relpose": relpose, "torquescale": values["torquescale"]}
        for number, (kind, index) in enumerate(equality_ends(model, equality), 1):
            if index >= 0:
                values[f"{kind}{number}"] = self.name(kind, index)
        _add(
            section,
            tag,
            name=self.name("equality", equality),
            active=bool(model.eq_active0[equality]),
            solref=model.eq_solref[equality],
            solimp=model.eq_solimp[equality],
            **values,
        )

    def _write_actuator(self, section: Element, actuator: int) -> None:
        model = self.model
        transmission = self.word(_TRANSMISSIONS, model.actuator_trntype, "actuator", actuator)
        values: dict[str, Any] = {
            word: self.name(*end)
            for word, end in zip(TARGETS[transmission], actuator_ends(model, actuator), strict=True)
            if end[1] >= 0
        }
        if transmission == "jointinparent":
            values = {transmission: values["joint"]}
        if transmission == "slidercrank":
            values["cranklength"] = model.actuator_cranklength[actuator]
        for limit in ("ctrl", "force", "act"):
            values[f"{limit}limited"] = bool(getattr(model, f"actuator_{limit}limited")[actuator])
            values[f"{limit}range"] = getattr(model, f"actuator_{limit}range")[actuator]
        if model.actuator_actnum[actuator]:
            values["actdim"] = model.actuator_actnum[actuator]
        if transmission in ("joint", "jointinparent", "tendon"):
            values["damping"] = (model.actuator_damping[actuator], *model.actuator_dampingpoly[actuator])
            values["armature"] = model.actuator_armature[actuator]
        _add(
            section,
            "general",
            name=self.name("actuator", actuator),
            gear=model.actuator_gear[actuator],
            dyntype=self.word(_DYNAMICS, model.actuator_dyntype, "actuator", actuator),
            gaintype=self.word(_GAINS, model.actuator_gaintype, "actuator", actuator),
            biastype=self.word(_BIASES, model.actuator_biastype, "actuator", actuator),
            dynprm=model.actuator_dynprm[actuator],
            gainprm=model.actuator_gainprm[actuator],
            biasprm=model.actuator_biasprm[actuator],
            lengthrange=model.actuator_lengthrange[actuator],
            actearly=bool(model.actuator_actearly[actuator]),
            **values,
        )


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
