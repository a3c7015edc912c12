"""Terms of joints, judged by numpy."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.worker.terms_rig import JOINTS, WORLDS, Rig, terms_of


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return Rig(terms_of("joints"), tmp_path_factory.mktemp("joints"))


def column(rig: Rig, joint: int) -> dict[str, np.ndarray]:
    """What a joint is and does, read by hand."""
    coordinate, dof = int(rig.robot.coordinates.numpy()[joint]), int(rig.robot.dofs.numpy()[joint])
    return {
        "q": rig.q[:, coordinate],
        "qd": rig.qd[:, dof],
        "force": rig.worlds.drives.numpy()[:, dof],
        "acceleration": rig.worlds.warm_start.numpy()[:, dof],
        "bias": rig.robot.encoder_bias.numpy()[:, joint],
        "default": rig.robot.defaults.numpy()[joint],
        "low": rig.robot.ranges.numpy()[joint, 0],
        "high": rig.robot.ranges.numpy()[joint, 1],
        "effort": rig.robot.efforts.numpy()[joint],
    }


def test_every_term_of_a_joint_is_its_formula(rig: Rig) -> None:
    formulas = {
        "joint_position": lambda c: c["q"],
        "measured_joint_position": lambda c: c["q"] + c["bias"],
        "joint_offset": lambda c: c["q"] - c["default"],
        "measured_joint_offset": lambda c: c["q"] + c["bias"] - c["default"],
        "joint_velocity": lambda c: c["qd"],
        "joint_share_of_range": lambda c: (
            2 * (c["q"] - c["low"]) / (c["high"] - c["low"]) - 1 if np.isfinite(c["low"]) else 0 * c["q"]
        ),
        "joint_acceleration": lambda c: c["acceleration"],
        "joint_effort": lambda c: c["force"],
        "joint_effort_share": lambda c: c["force"] / c["effort"],
        "joint_power": lambda c: c["force"] * c["qd"],
        "joint_velocity_squared": lambda c: c["qd"] ** 2,
        "joint_speed": lambda c: np.abs(c["qd"]),
        "joint_acceleration_squared": lambda c: c["acceleration"] ** 2,
        "joint_effort_squared": lambda c: c["force"] ** 2,
        "joint_effort_magnitude": lambda c: np.abs(c["force"]),
        "joint_work": lambda c: np.maximum(c["force"] * c["qd"], 0),
        "joint_power_magnitude": lambda c: np.abs(c["force"] * c["qd"]),
        "joint_deviation": lambda c: np.abs(c["q"] - c["default"]),
        "joint_deviation_squared": lambda c: (c["q"] - c["default"]) ** 2,
        "joint_beyond_limits": lambda c: (c["q"] < c["low"]) | (c["q"] > c["high"]),
    }
    for name, formula in formulas.items():
        for joint in range(JOINTS):
            found = rig.call(name, joint)
            np.testing.assert_allclose(found, formula(column(rig, joint)), rtol=2e-5, atol=1e-6, err_msg=name)


def test_terms_with_numbers(rig: Rig) -> None:
    for joint in range(JOINTS):
        c = column(rig, joint)
        span = 0.0 if np.isinf(c["high"]) else 0.1 * (c["high"] - c["low"])
        beyond = np.maximum(c["low"] + span - c["q"], 0) + np.maximum(c["q"] - c["high"] + span, 0)
        np.testing.assert_allclose(rig.call("joint_limit_excess", joint, soft_factor=0.8), beyond, atol=2e-6)
        speed, force = np.abs(c["qd"]), np.abs(c["force"])
        excess = np.clip(speed - 0.5, 0, 1)
        np.testing.assert_allclose(rig.call("joint_velocity_excess", joint, limit=0.5), excess, atol=1e-6)
        hinge = np.maximum(speed - 0.5, 0) ** 2
        np.testing.assert_allclose(rig.call("joint_velocity_excess_squared", joint, limit=0.5), hinge, atol=1e-5)
        excess = np.maximum(force - 0.5 * c["effort"], 0)
        np.testing.assert_allclose(rig.call("joint_effort_excess", joint, soft_factor=0.5), excess, atol=1e-6)
        assert (rig.call("joint_effort_at_limit", joint, soft_factor=0.5) == (force >= 0.5 * c["effort"])).all()
        assert (rig.call("joint_too_fast", joint, limit=0.7) == (speed > 0.7)).all()
        outside = (c["q"] < -0.4) | (c["q"] > 0.3)
        assert (rig.call("joint_out_of_range", joint, bounds=(-0.4, 0.3)) == outside).all()
        error = np.angle(np.exp(1j * (c["q"].astype(float) - 5.0)))
        np.testing.assert_allclose(rig.call("joint_target_error_squared", joint, target=5.0), error**2, rtol=1e-4)


def test_the_random_worlds_have_joints_on_both_sides_of_every_limit(rig: Rig) -> None:
    for name, numbers in (("joint_beyond_limits", {}), ("joint_too_fast", {"limit": 0.7}), ("joint_limit_excess", {})):
        found = np.stack([rig.call(name, joint, **numbers) > 0 for joint in range(JOINTS)])
        assert found.shape == (JOINTS, WORLDS) and 0 < found.sum() < found.size, name
