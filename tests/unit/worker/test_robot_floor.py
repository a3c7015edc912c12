"""What differs between the floor of a robot's file, which is left out, and Muster's ground is noted."""

from __future__ import annotations

import pytest

from tests.support.worker.robot_texts import BOX, HINGE, mjcf, read, template, twins
from worker.simulation.collisions import Collision
from worker.simulation.robot import Robot
from worker.simulation.worlds import Worlds

SCENE = (
    '<mujoco>{before}<worldbody>{floor}<body name="b" pos="0 0 .5"><freejoint/><geom name="g" type="box" size=".1 .12 .13"{geom}/></body>'
    "</worldbody>{rest}</mujoco>"
)
SECOND_BIT = ' contype="2" conaffinity="2"'
MASKS = "Muster's ground (contype 1 and conaffinity 1)"
KEEP = "to keep the file's floor, give Robot ignore=() and the task ground=False"


def scene(floor: str = "", geom: str = "", rest: str = "", before: str = "", kind: str = "plane") -> str:
    whole = floor if floor.startswith("<") else f'<geom name="floor" type="{kind}" size="5 5 .1"{floor}/>'
    return SCENE.format(floor=whole, geom=geom, rest=rest, before=before)


def other(*words: str) -> str:
    return f"Muster's ground takes the place of the file's floor, which has {', '.join(words)}; {KEEP}"


FALLS = "; give these geoms other masks by collisions=(Collision(...),); or, " + KEEP
NOTES = {
    "the same masks": (scene(), ()),
    "another bit": (
        scene(SECOND_BIT, SECOND_BIT),
        (f"{MASKS} does not hold what the file's floor (contype 2 and conaffinity 2) holds: geom g{FALLS}",),
    ),
    "a geom that asks for one bit": (
        scene(' contype="3" conaffinity="3"', ' contype="0" conaffinity="2"'),
        (f"{MASKS} does not hold what the file's floor (contype 3 and conaffinity 3) holds: geom g{FALLS}",),
    ),
    "a floor that does not hold it": (
        scene(SECOND_BIT),
        (f"Muster's ground touches what the file's floor (contype 2 and conaffinity 2) does not: geom g; {KEEP}",),
    ),
    "a floor that is only seen": (scene(' contype="0" conaffinity="0" pos="0 0 -1"'), ()),
    "a height": (scene(' pos="0 0 -.5"'), (other("another height (-0.5 m)"),)),
    "a tilt": (scene(' euler="10 0 0"'), (other("another tilt (10 degrees)"),)),
    "a box": (scene(kind="box"), (other("another shape (box)"),)),
    "less friction: the greater one counts": (scene(' friction=".1"'), ()),
    "more friction": (scene(' friction="2"'), (other("another friction (with geom g 2, here 1)"),)),
    "friction about more axes": (
        scene(' friction="2 .1" condim="4"'),
        (other("another condim (with geom g 4, here 3)", "another friction (with geom g 2 0.1, here 1)"),),
    ),
    "a priority": (
        scene(' friction=".3" solref=".01 1" priority="1"'),
        (other("another friction (with geom g 0.3, here 1)", "another solref (with geom g 0.01 1, here 0.02 1)"),),
    ),
    "defaults and frames": (
        scene(
            '<frame pos="0 0 1"><geom name="floor" class="f"/></frame>',
            before='<default><default class="f"><geom type="plane" size="1 1 1" friction="3"/></default></default>',
        ),
        (other("another height (1 m)", "another friction (with geom g 3, here 1)"),),
    ),
    "a static body": (
        scene('<body pos="0 0 1"><geom name="floor" type="plane" size="1 1 1" pos="0 0 1"/></body>'),
        (other("another height (2 m)"),),
    ),
}


@pytest.mark.parametrize(("file", "notes"), NOTES.values(), ids=NOTES)
def test_what_muster_s_ground_has_otherwise_is_noted(file: str, notes: tuple[str, ...]) -> None:
    assert read(file).notes == notes


def test_a_floor_matters_only_as_far_as_the_task_follows_the_file() -> None:
    file = scene(SECOND_BIT + ' friction="2" pos="0 0 -1"', SECOND_BIT)
    assert len(read(file).notes) == 2
    assert read(file, position=(0.0, 0.0, 1.0), collisions=(Collision("*"),)).notes == ()
    assert read(file, ignore=()).notes == ()


def height(file: str, ground: bool, **options: object) -> float:
    """Height of the robot after a second [m]."""
    worlds = Worlds(
        template(Robot(file, passive=True, **options)),  # type: ignore[arg-type]
        1,
        "cpu",
        timestep=0.002,
        substeps=500,
        fastest=1e9,
        ground=ground,
        solver_options={"njmax": 50, "nconmax": 20},
    )
    worlds.simulate()
    return float(worlds.solver.mjw_data.qpos.numpy()[0, 2])


def test_what_the_note_says_holds_the_robot() -> None:
    file = scene(SECOND_BIT, SECOND_BIT, '<actuator><motor name="m" joint="k"/></actuator>').replace(
        "</body>", f'<body name="c"><joint name="k"/>{BOX}</body></body>'
    )
    assert height(file, True) < -1.0
    for found in (height(file, False, ignore=()), height(file, True, collisions=(Collision("*"),))):
        assert 0.05 < found < 0.2


def test_a_contact_pair_of_a_geom_that_is_left_out_is_left_out_with_a_note() -> None:
    file = scene(rest='<contact><pair geom1="floor" geom2="g"/></contact>')
    assert read(file).notes == ("the contact pair of floor and g is left out, since floor is; ignore=() keeps both",)
    kept = read(file, ignore=())
    assert not kept.notes and twins(kept).built.npair == 1


def test_a_tendon_around_a_geom_that_is_left_out_is_refused_with_what_to_do() -> None:
    wrapped = '<site name="s"/><site name="t" pos=".2 0 0"/><geom name="floor" size=".1" mass="1"/>'
    tendon = '<tendon><spatial><site site="s"/><geom geom="floor"/><site site="t"/></spatial></tendon>'
    with pytest.raises(
        ValueError, match=r"geom 'floor' not found in tendon .*; the robot's ignore leaves it out: give"
    ):
        read(mjcf(HINGE + BOX + wrapped, tendon))
