"""The identity of a robot: every value that makes it another one is in it, by its element and with both values."""

from __future__ import annotations

import pytest

from shared_store.contract.policy_changes import robot_changes
from tests.support.worker.robot_texts import read
from worker.simulation.robot_reading import Reading

ARM = """<mujoco><option {option}>{flag}</option><default><joint {joint}/><geom {geom}/></default>
<asset><hfield name="f" size="1 1 .2 .1" nrow="2" ncol="2" elevation="0 1 0 {height}"/></asset>
<worldbody><geom name="hills" type="hfield" hfield="f"/><body name="b" pos="0 0 1"><joint name="j" axis="0 1 0" range="-60 60"/>
<geom name="h" type="capsule" fromto="0 0 0 0.1 0 0.3" size=".02"/><site name="s"/>
<body name="c" pos="0.1 0 0.3"><joint name="k" axis="0 1 0"/><geom name="l" type="box" size=".1 .02 .03" pos=".1 0 0"/></body></body>
<body name="d" pos="1 0 1"><joint name="x" type="slide" axis="0 0 1"/><geom name="m" type="box" size=".1 .2 .3"/></body></worldbody>
<contact>{pair}</contact><equality><joint joint1="j" joint2="k" {equality}/></equality>
<tendon><fixed name="t" range="-1 1" {tendon}><joint joint="j" coef="1"/><joint joint="k" coef="2"/></fixed></tendon>
<actuator><motor name="{first}" joint="j"/><motor name="{second}" joint="k"/>
<general name="g" joint="x" dyntype="filter" dynprm="1" {actuator}/></actuator></mujoco>"""
PLAIN = {
    **dict.fromkeys(["option", "flag", "joint", "geom", "equality", "tendon", "actuator"], ""),
    **{"height": "1", "first": "p", "second": "q", "joint": 'frictionloss="1"', "pair": '<pair geom1="h" geom2="m"/>'},
    **{
        "tendon": 'limited="false"',
        "actuator": 'ctrllimited="false" ctrlrange="-1 1" actlimited="true" actrange="-1 1"',
    },
}
CHANGES = {
    "contacts": ({"flag": '<flag contact="disable"/>'}, "option: disableflags 0 became contact"),
    "integrator": ({"option": 'integrator="RK4"'}, "option: integrator 0 became 1"),
    "cone": ({"option": 'cone="elliptic"'}, "option: cone 0 became 1"),
    "solver": ({"option": 'solver="CG"'}, "option: solver 2 became 1"),
    "wind": ({"option": 'wind="9 0 0"'}, "option: wind 0 became 9 0 0"),
    "an equality off": ({"equality": 'active="false"'}, "equality equality_0: active0 1 became 0"),
    "a tendon's limit": ({"tendon": 'limited="true"'}, "tendon t: limited 0 became 1"),
    "a control's limit": (
        {"actuator": 'ctrllimited="true" ctrlrange="-1 1" actlimited="true" actrange="-1 1"'},
        "actuator g: ctrllimited 0 became 1; actuator g: ctrlrange 0 became -1 1",
    ),
    "a rotor": ({"actuator": PLAIN["actuator"] + ' armature="1"'}, "actuator g: armature 0 became 1"),
    "a pair": ({"pair": ""}, "contact pair 0 is gone"),
    "a pair's friction": (
        {"pair": '<pair geom1="h" geom2="m" friction="3 3 .1 .1 .1"/>'},
        "contact pair 0: friction 1 1 0.005 0.0001 0.0001 became 3 3 0.1 0.1 0.1",
    ),
    "actuatorgravcomp": (
        {"joint": 'frictionloss="1" actuatorgravcomp="true"'},
        "joint j: actgravcomp 0 became 1; joint k: actgravcomp 0 became 1; joint x: actgravcomp 0 became 1",
    ),
    "priority": ({"geom": 'priority="2"'}, "geom hills: priority 0 became 2"),
    "solreffriction": (
        {"joint": 'frictionloss="1" solreffriction=".2 1"'},
        "joint j: solreffriction 0.02 1 became 0.2 1",
    ),
    "swapped names": ({"first": "q", "second": "p"}, "actuator q: drives k became j; actuator p: drives j became k"),
    "heights": ({"height": "0.5"}, "geom hills: shape and place 0 0 0 1 0 0 0 1 0 0 0 1 1 1 0.2 0.1 0 1 0 1 became"),
}


def arm(**changes: str) -> Reading:
    return read(ARM.format(**{**PLAIN, **changes}))


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_value_is_in_the_identity_and_named(change: str) -> None:
    changed, line = CHANGES[change]
    before, now = arm().identity, arm(**changed).identity
    (output,) = robot_changes([before], [now])
    assert line in output


def test_options_that_do_not_apply_do_not_count() -> None:
    texts = [ARM.format(**{**PLAIN, "option": option}) for option in ("", 'iterations="3" gravity="0 0 -3"')]
    one, other = (read(text, file_options=False).identity for text in texts)
    assert one == other
    assert read(ARM.format(**{**PLAIN, "option": 'timestep="0.1"'})).identity == arm().identity


def test_an_accepted_difference_is_shown_and_is_in_the_identity() -> None:
    text = """<mujoco><option density="1"/><worldbody><body name="b"><joint name="j" axis="0 1 0"/><inertial pos="0 0 .1" mass="1"
diaginertia="1 2 2.5"/><geom size=".1" fluidshape="ellipsoid"/></body></worldbody></mujoco>"""
    with pytest.raises(ValueError, match="accept=") as refused:
        read(text)
    pattern = str(refused.value).split("accept=('")[1].split("'")[0]
    accepted = read(text, accept=(pattern, "model: *", "geom *", "joint *", "arm: mass"))
    element, _, field = pattern.rpartition(": ")
    assert any(note.startswith(f"accepted: {element}: {field} is ") for note in accepted.notes)
    assert "accept='arm: mass' matches no difference from the file" in accepted.notes
    assert field not in accepted.identity.elements[element]  # zeros of the robot that is built
    plain = read(text.replace(' fluidshape="ellipsoid"', ""))
    assert accepted.identity.elements[element] == plain.identity.elements[element]
