"""What is drawn, when, and what becomes of it: ranges, streams, resets, intervals, resumption, capture and refusals."""

from __future__ import annotations

import re
from typing import Any

import mujoco
import newton
import newton.examples
import numpy as np
import pytest
import torch

from tests.support.refusals import refusal
from tests.support.worker.randomized_worlds import CONTROL_HZ, build_arm, build_episodes, build_worlds, randomize
from worker.simulation.actuators import EffortActuator
from worker.simulation.capture import CapturedStep
from worker.simulation.declared_randomization import Randomize
from worker.simulation.episodes import EpisodeArrays
from worker.simulation.randomizations import Randomizations
from worker.simulation.robot import Robot
from worker.simulation.worlds import Worlds

MIXED = {
    "mass": Randomize("mass", bodies="*", range=(0.5, 2.0), distribution="log_uniform"),
    "center": Randomize("center_of_mass", bodies="hand", range={"x": (-0.01, 0.01)}, operation="add", when="reset"),
    "armature": Randomize(
        "armature", joints="*", range=(0.01, 0.03), operation="set", when="interval", seconds=(0.1, 0.2)
    ),
    "bias": Randomize("encoder_bias", joints=("elbow", "wrist"), range=(-0.1, 0.1), operation="add", when="reset"),
    "strength": Randomize("motor_strength", actuators="*", range=(0.8, 1.2), shared=True, when="reset"),
    "weaker": Randomize("motor_strength", actuators="wrist", range=(0.4, 0.6), when="reset"),
}
FIELDS = [
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_invweight0",
    "dof_armature",
    "dof_invweight0",
    "actuator_gainprm",
]


def fields(worlds: Worlds) -> dict[str, np.ndarray]:
    return {name: getattr(worlds.solver.mjw_model, name).numpy().copy() for name in FIELDS}


def mixed(count: int = 2, **keys: int) -> tuple[Worlds, EpisodeArrays, Randomizations]:
    """Arms with all of :data:`MIXED`."""
    (worlds, view), episodes = build_arm(count), build_episodes(count, **keys)
    return worlds, episodes, randomize(MIXED, worlds, view, episodes)


def set_ages(episodes: EpisodeArrays, ages: list[int]) -> None:
    episodes.ages.assign(np.array(ages, np.int32))


def columns(randomizations: Randomizations, entry: str) -> list[int]:
    return [index for index, name in enumerate(randomizations.names) if name.partition("/")[0] == entry]


def play(randomizations: Randomizations, episodes: EpisodeArrays, steps: range) -> None:
    """Steps in which world 1 begins a new episode in every third, the others never."""
    for step in steps:
        set_ages(episodes, [1 + step] + [step % 3] + [1 + step] * (episodes.ages.shape[0] - 2))
        randomizations.settle()


def test_draws_fill_their_ranges_and_follow_their_distributions() -> None:
    worlds, view = build_arm(400)
    entries = {
        "mass": Randomize("mass", bodies="hand", range=(0.5, 2.0), distribution="log_uniform"),
        "damping": Randomize("joint_damping", joints="elbow", range=(1.0, 3.0)),
        "bias": Randomize("encoder_bias", joints="wrist", range=(0.2, 0.05), operation="add", distribution="normal"),
    }
    mass, damping, bias = randomize(entries, worlds, view).draws.double().numpy().T
    for drawn, low, high in ((mass, 0.5, 2.0), (damping, 1.0, 3.0)):
        assert low <= drawn.min() < low + 0.02 * (high - low) and high - 0.02 * (high - low) < drawn.max() <= high
    # 4 standard deviations of each statistic
    assert abs(np.log(mass).mean()) < 4 * np.log(4) / np.sqrt(12 * 400)
    assert abs(damping.mean() - 2) < 4 * 2 / np.sqrt(12 * 400)
    assert abs(bias.mean() - 0.2) < 4 * 0.05 / 20 and abs(bias.std() - 0.05) < 4 * 0.05 / np.sqrt(800)
    assert abs(np.corrcoef([mass, damping, bias])[np.triu_indices(3, 1)]).max() < 0.2


def test_what_a_world_draws_does_not_depend_on_how_many_there_are_or_on_later_entries() -> None:
    _, whole_episodes, whole = mixed(4)
    set_ages(whole_episodes, [0, 1, 0, 0])
    whole.settle()
    _, part_episodes, part = mixed(2, first_world=2)
    set_ages(part_episodes, [0, 0])
    part.settle()
    assert torch.equal(whole.draws[2:], part.draws)
    assert len(set(whole.draws[:, 0].tolist())) == 4
    alone = randomize({"mass": MIXED["mass"]}, *build_arm(2), build_episodes(2, first_world=2))
    assert torch.equal(alone.draws, part.draws[:, columns(part, "mass")])


def test_entries_apply_in_order_to_the_models_own_values_and_never_compound() -> None:
    worlds, view = build_arm()
    own = fields(worlds)
    entries = {
        "more": Randomize("mass", bodies="fore", range=(1.0, 2.0), when="reset"),
        "load": Randomize("mass", bodies="fore", range=(0.1, 0.2), operation="add", when="reset"),
        "strength": MIXED["strength"],
        "weaker": MIXED["weaker"],
    }
    randomizations = randomize(entries, worlds, view)
    seen = set()
    for _ in range(5):
        randomizations.settle()
        more, load, strength, weaker = randomizations.draws.numpy().T
        now = fields(worlds)
        np.testing.assert_allclose(now["body_mass"][:, 2], 0.8 * more + load, rtol=1e-5)
        ratio = (0.8 * more + load) / 0.8
        np.testing.assert_allclose(
            np.sort(now["body_inertia"][:, 2]), np.sort(own["body_inertia"][:, 2]) * ratio[:, None], rtol=1e-5
        )
        gains = own["actuator_gainprm"][:, :, 0] * strength[:, None]
        gains[:, 2] *= weaker
        np.testing.assert_allclose(now["actuator_gainprm"][:, :, 0], gains, rtol=1e-5)
        np.testing.assert_array_equal(now["body_mass"][:, [1, 3, 4]], own["body_mass"][:, [1, 3, 4]])
        seen.add(float(more[0]))
    assert len(seen) == 5


def test_a_startup_stays_a_reset_comes_with_an_episode_and_an_interval_in_its_time() -> None:
    worlds, view = build_arm(3)
    episodes, robot = build_episodes(3), view.arrays(worlds)
    randomizations = randomize(MIXED, worlds, view, episodes, robot)
    startup, reset = columns(randomizations, "mass"), columns(randomizations, "bias")
    interval = columns(randomizations, "armature")
    first, last = randomizations.draws.clone(), randomizations.draws.clone()
    between: list[int] = []
    since = 0
    for step in range(60):
        play(randomizations, episodes, range(step, step + 1))
        now = randomizations.draws.clone()
        assert torch.equal(now[:, startup], first[:, startup])
        assert torch.equal(now[[0, 2]][:, reset], first[[0, 2]][:, reset])
        assert (now[1, reset] != last[1, reset]).all() == (step % 3 == 0)
        # A new episode begins its intervals afresh: in an episode of three steps none ends.
        assert torch.equal(now[1, interval], first[1, interval])
        since += 1
        if (now[0, interval] != last[0, interval]).any():
            between.append(since)
            since = 0
        np.testing.assert_array_equal(robot.encoder_bias.numpy()[:, [1, 2]], now[:, reset].numpy())
        np.testing.assert_allclose(worlds.solver.mjw_model.dof_armature.numpy(), now[:, interval].numpy(), rtol=1e-6)
        last = now
    assert set(between) <= set(range(int(0.1 * CONTROL_HZ), int(0.2 * CONTROL_HZ) + 1)) and len(set(between)) > 2
    assert (robot.encoder_bias.numpy()[:, [0, 3]] == 0).all()


def test_a_resumed_run_goes_on_bit_for_bit() -> None:
    worlds, episodes, randomizations = mixed()
    play(randomizations, episodes, range(7))
    saved = {name: tensor.clone() for name, tensor in randomizations.state_tensors().items()}
    random = episodes.random.numpy().copy()
    assert all(len(tensor) == 2 for tensor in saved.values())
    play(randomizations, episodes, range(7, 30))

    other_worlds, other_episodes, other = mixed(seed=99)
    other_episodes.random.assign(random)
    for name, tensor in other.state_tensors().items():
        tensor.copy_(saved[name])
    other.apply()
    play(other, other_episodes, range(7, 30))
    for name, tensor in randomizations.state_tensors().items():
        assert torch.equal(tensor, other.state_tensors()[name]), name
    expected, got = fields(worlds), fields(other_worlds)
    for name in FIELDS:
        np.testing.assert_array_equal(got[name], expected[name], err_msg=name)


def test_a_captured_step_equals_its_launches() -> None:
    results = []
    for captured in (False, True):
        worlds, episodes, randomizations = mixed()
        settle = randomizations.settle
        if captured:
            settle()
            settle = CapturedStep(randomizations.settle, "cpu").launch
            episodes.random.assign(build_episodes().random.numpy())
            randomizations.restart()
        for step in range(12):
            set_ages(episodes, [step % 4, 1])
            settle()
        results.append({**fields(worlds), "draws": randomizations.draws.numpy().copy()})
    for name, expected in results[0].items():
        np.testing.assert_array_equal(results[1][name], expected, err_msg=name)


def test_ranges_are_numbers_that_may_change_while_worlds_run() -> None:
    _, _, randomizations = mixed()
    numbers = randomizations.numbers()
    assert {name: tuple(tensor.shape) for name, tensor in numbers.items()} == {
        "mass.range": (1, 2),
        "center.range.x": (2,),
        "armature.range": (1, 2),
        "armature.seconds": (2,),
        "bias.range": (1, 2),
        "strength.range": (1, 2),
        "weaker.range": (1, 2),
    }
    numbers["bias.range"].copy_(torch.tensor([0.5, 0.6]))
    numbers["center.range.x"].copy_(torch.tensor([0.02, 0.02]))
    randomizations.settle()
    bias = randomizations.draws[:, columns(randomizations, "bias")]
    assert ((bias >= 0.5) & (bias <= 0.6)).all()
    assert (randomizations.draws[:, columns(randomizations, "center")] == 0.02).all()


def test_no_draw_makes_a_value_impossible() -> None:
    worlds, view = build_arm(100)
    own = fields(worlds)
    wide: Any = {"range": (1.0, 5.0), "distribution": "normal"}
    entries = {
        "mass": Randomize("mass", bodies="*", operation="add", **wide),
        "inertia": Randomize("inertia", bodies="hand", axes=("x", "y", "z"), **wide),
        "armature": Randomize("armature", joints="*", **wide),
        "stiffness": Randomize("stiffness", actuators="s*", **wide),
        "limit": Randomize("effort_limit", actuators="shoulder", operation="add", **wide),
    }
    randomizations = randomize(entries, worlds, view)
    assert (randomizations.draws < 0).any(0).all()
    model, now = worlds.solver.mjw_model, fields(worlds)
    assert (now["body_mass"][:, 1:] >= 0.0099 * own["body_mass"][:, 1:]).all()
    moments = np.sort(now["body_inertia"][:, 1:], axis=-1)
    assert (moments > 0).all() and (moments[..., 0] + moments[..., 1] >= (1 - 1e-4) * moments[..., 2]).all()
    assert now["dof_armature"].min() == 0.0
    assert np.isfinite(now["dof_invweight0"]).all() and (now["dof_invweight0"] > 0).all()
    gain, bias = model.actuator_gainprm.numpy()[:, 0, 0], model.actuator_biasprm.numpy()[:, 0, 1]
    assert gain.min() == 0.0
    np.testing.assert_array_equal(gain, -bias)
    limit = model.actuator_forcerange.numpy()[:, 0]
    assert limit[:, 1].min() == 0.0
    np.testing.assert_array_equal(limit[:, 0], -limit[:, 1])


URDF = """<robot name="arm"><link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tip"><inertial><origin xyz="0.3 0 0"/><mass value="1"/><inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="elbow" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="5" velocity="2"/></joint>
</robot>"""


def test_limits_of_a_urdf_joint_stay_as_stiff_when_masses_change() -> None:
    robot = Robot(URDF, fixed=True, actuators=[EffortActuator("*")])
    worlds, view = build_worlds(robot, njmax=10, nconmax=0, disable_contacts=True)
    own = worlds.solver.mjw_model.jnt_solref.numpy().copy()
    randomize({"mass": Randomize("mass", bodies="tip", range=(3.0, 5.0))}, worlds, view)
    got = worlds.solver.mjw_model.jnt_solref.numpy()
    worlds.solver.notify_model_changed(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)
    np.testing.assert_allclose(got, own, rtol=1e-6)
    np.testing.assert_allclose(got, worlds.solver.mjw_model.jnt_solref.numpy(), rtol=1e-4)


def reference_weights(model: mujoco.MjModel, factors: np.ndarray) -> dict[str, np.ndarray]:
    model.body_mass[1:] *= factors
    model.body_inertia[1:] *= factors[:, None]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return {name: getattr(model, name).copy() for name in ("body_invweight0", "dof_invweight0", "tendon_invweight0")}


TENDON = """<mujoco><worldbody><body pos="0 0 1"><freejoint name="root"/><geom size="0.1" pos="0 0.01 0"/>
  <body pos="0.2 0 0"><joint name="ball" type="ball"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
  <body pos="0.3 0 0"><joint name="knee" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.2 0 0.1" size="0.02"/>
    <body pos="0.1 0 0"><geom size="0.03"/></body>
    <body pos="0.2 0 0.1"><joint name="toe" axis="0 0 1"/><geom size="0.03" pos="0.05 0 0"/></body>
  </body></body></body></worldbody>{}<actuator><motor joint="knee"/></actuator></mujoco>"""
FIXED_TENDON = '<tendon><fixed limited="true" range="-1 1"><joint joint="knee" coef="1"/><joint joint="toe" coef="-2"/></fixed></tendon>'


SLIDER = (
    '<body pos="3 0 1"><joint name="rail" type="slide" axis="0 0 1" armature="2"/><geom size="0.1"/></body></worldbody>'
)


@pytest.mark.parametrize(
    "kind", ["free and ball joints", "a tendon", "a slider", "a slider and a tendon", "a humanoid"]
)
def test_inverse_weights_follow_the_masses_as_in_mujoco(kind: str) -> None:
    text = TENDON.format(FIXED_TENDON if "a tendon" in kind else "")
    if "a slider" in kind:
        text = text.replace("</worldbody>", SLIDER)
    if kind == "a humanoid":
        with open(newton.examples.get_asset("nv_humanoid.xml")) as file:
            text = re.sub("<sensor>.*</sensor>", "", file.read(), flags=re.DOTALL)  # MuJoCo refuses the file's own
    worlds, view = build_worlds(Robot(text, passive=True) if "a slider" in kind else text, njmax=120, nconmax=60)
    entries = {"mass": Randomize("mass", bodies="*", range=(0.3, 3.0), when="reset")}
    randomizations = randomize(entries, worlds, view)
    step = CapturedStep(randomizations.settle, "cpu")
    for _ in range(2):
        step.launch()
    assert worlds.solver.mj_model.nbody == 1 + len(view.body_names)
    for world in range(2):
        # in the order of MuJoCo, which is Newton's here
        expected = reference_weights(mujoco.MjModel.from_xml_string(text), randomizations.draws[world].double().numpy())
        for name, values in expected.items():
            got = getattr(worlds.solver.mjw_model, name).numpy()[world]
            if "a slider" in kind and name == "body_invweight0":
                assert got[-1, 1] == pytest.approx(0.01 * got[-1, 0])  # next to MuJoCo's 0
                got[-1, 1] = 0.0
            np.testing.assert_allclose(got, values, rtol=3e-4, err_msg=name)


@pytest.mark.parametrize(
    ("what", "options", "message"),
    [
        ("friktion", {"geoms": "*"}, "nothing is called 'friktion'; did you mean friction?"),
        ("mass", {"geoms": "*"}, "geoms='*' does not fit; give bodies=..."),
        ("mass", {}, 'bodies is required; all of them are bodies="*"'),
        ("gravity", {"bodies": "*"}, "it belongs to the whole world; leave it out"),
        ("mass", {"bodies": "*", "range": (2.0, 1.0)}, "(2.0, 1.0) is empty: its first number is the lesser one"),
        ("mass", {"bodies": "*", "range": (-1.0, 1.0)}, "would make mass negative; use numbers above 0"),
        ("mass", {"bodies": "*", "range": (0.0, 1.0)}, "would make mass zero; use numbers above 0"),
        ("payload", {"bodies": "*", "range": (-1.0, 1.0), "operation": "add"}, "to take mass away: what='mass'"),
        ("armature", {"joints": "*", "range": (-1.0, 1.0), "operation": "set"}, "would make armature negative"),
        ("mass", {"bodies": "*", "range": (1.0, float("inf"))}, "is not finite"),
        ("mass", {"bodies": "*", "range": (1.0,)}, "is not a pair; give two numbers, such as (0.8, 1.2)"),
        ("gravity", {"range": (0.0, 1.0), "distribution": "log_uniform"}, "has no logarithm"),
        ("gravity", {"range": (0.0, -1.0), "distribution": "normal"}, "a mean and a standard deviation"),
        ("gravity", {"distribution": "gaussian"}, "can't be 'gaussian'; available: uniform, log_uniform, normal"),
        ("gravity", {"when": "restart"}, "when can't be 'restart'"),
        ("payload", {"bodies": "*", "operation": "scale"}, "operation can't be 'scale'"),
        ("friction", {"geoms": "*", "axes": ("rolling",)}, "it has no axis 'rolling'; did you mean roll?"),
        ("armature", {"joints": "*", "axes": ("x",)}, "it has no axis 'x'; it is one number"),
        ("gravity", {"when": "interval"}, "seconds is required, such as seconds=(10.0, 15.0)"),
        ("gravity", {"seconds": (1.0, 2.0)}, "seconds is for when='interval' alone"),
        ("gravity", {"when": "interval", "seconds": (2.0, 1.0)}, "give two times above 0, the lesser first"),
        ("mass", {"bodies": "*", "at": (0.0, 0.0, 1.0)}, "only a payload has a place"),
    ],
)
def test_an_invalid_declaration_is_refused(what: str, options: dict[str, Any], message: str) -> None:
    assert message in refusal(Randomize, what, **{"range": (0.5, 1.0), **options})


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (Randomize("mass", bodies="leg*", range=(1.0, 2.0)), "no body of robot matches 'leg*'"),
        (Randomize("mass", bodies="*", range=(1.0, 2.0), robot="cube"), "no robot or object is called 'cube'"),
        (Randomize("friction", geoms="*", range=(1.0, 2.0)), "so they have no friction; choose geoms that collide"),
        (Randomize("stiffness", actuators="wrist", range=(1.0, 2.0)), "is a motor, which has no stiffness"),
        (Randomize("stiffness", actuators="elbow", range=(1.0, 2.0)), "is a velocity actuator, which has no stiffness"),
        (Randomize("effort_limit", actuators="*", range=(1.0, 2.0)), "joint elbow of robot's actuator is not limited"),
    ],
)
def test_a_missing_part_is_refused_with_the_entrys_name(entry: Randomize, message: str) -> None:
    output = refusal(randomize, {"mine": entry}, *build_arm())
    assert output.startswith("randomize.mine: ") and message in output
