"""Recordings, pictures and viewers show the links of a robot's file, and none of the bodies that only carry a joint."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.support.worker.declared import Small, SmallConfig
from worker.tasks import Action, terms
from worker.telemetry.picture import StageCamera
from worker.telemetry.stage import Stage

TWO_JOINTS = """<mujoco><worldbody><body name="hip" pos="0 0 1">
<joint name="yaw" axis="0 0 1"/><joint name="pitch" axis="0 1 0" pos="0 0 .5"/><geom type="box" size=".1 .1 .1"/>
<body name="shin" pos="0 0 -.5"><joint name="knee" axis="0 1 0"/><geom size=".1"/></body></body></worldbody>
<actuator><motor joint="yaw"/></actuator></mujoco>"""


class TwoJoints(Small):
    text = TWO_JOINTS

    def sections(self) -> dict[str, Any]:
        return {"actions": {"force": Action(terms.effort, joints="yaw")}}


def test_a_body_of_two_joints_is_one_link() -> None:
    stage = Stage(TwoJoints, SmallConfig(), 2)
    assert stage.model.body_count == 2 * 3, "one body carries the first joint"
    assert stage.links == ["hip", "shin"] and stage.root == 0
    assert set(stage.meshes()) - {"ground", ""} == {"hip", "shin"}
    poses = stage.pose(np.array([[np.pi / 2, 0.0, 0.0], [0.0, np.pi, 0.0]]))
    assert poses.shape == (2, 2, 7)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(poses[0, 0], [0.0, 0.0, 1.0, 0.0, 0.0, half, half], atol=1e-6)
    np.testing.assert_allclose(poses[1, :, 2], [2.0, 2.5], atol=1e-6)  # it turned about a point 0.5 m above it
    image = StageCamera(stage, 64, 48).take(np.zeros((2, 3)))
    assert image.shape[-1] == 3 and image.std() > 0.0
