"""Go1 on rough ground: what it sees of the ground by MuJoCo's rays, its normal by numpy, levels, and the end of the terrain."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from tests.support.worker.terms_rig import matrix
from tests.support.worker.walkers import plain
from worker.tasks.velocity import Velocity

WORLDS = 4


@pytest.fixture(scope="module")
def rough() -> Velocity:
    return plain("Go1Rough", WORLDS)


def test_it_sees_what_rays_of_mujoco_meet_and_stands_upright_on_it(rough: Velocity) -> None:
    rough.seed(4)
    rough.reset()
    state = rough.state_dict()
    state["terrain_levels"][:] = 6
    state["terrain_kinds"][:] = torch.tensor([1, 3, 5, 6])
    rough.load_state_dict(state)
    rough.reset()
    model = rough.worlds.solver.mj_model
    data = mujoco.MjData(model)
    data.qpos[2] = 100.0  # out of the way
    mujoco.mj_forward(model, data)
    columns = [number for number, name in enumerate(rough.observation_names) if name.startswith("height_scan")]
    assert len(columns) == 17 * 11 and len(rough.observation_names) == 235
    upright = 2 + rough.reward_terms.index("upright")
    bumpy = 0
    for step in range(3):
        before = rough.state_dict()["episode_sums"].numpy()
        rough.step(0.3 * torch.randn(WORLDS, 12, generator=torch.Generator().manual_seed(step)))
        state = rough.state_dict()
        for world in range(WORLDS):
            assert not rough.dones[world]
            root = state["joint_q"].numpy()[world].astype(float)
            place, turn = root[:3], matrix(root[3:7])
            yaw = np.arctan2(turn[1, 0], turn[0, 0])
            points = []
            for y in np.linspace(-0.5, 0.5, 11):
                for x in np.linspace(-0.8, 0.8, 17):
                    way = np.array((np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y))
                    at = place[:2] + way
                    start, geom = np.array([*at, 20.0]), np.zeros(1, np.int32)
                    down = mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), None, 1, -1, geom)
                    points.append([*at, 20.0 - down])
            ground = np.array(points)
            seen = rough.observations[world].numpy()[columns]
            np.testing.assert_allclose(seen, (place[2] - ground[:, 2]) / 5.0, atol=2e-3)
            some = ground[np.arange(32) * 186 // 31]
            values, vectors = np.linalg.eigh(np.cov(some.T))
            normal = vectors[:, 0] * np.sign(vectors[2, 0])
            if values[0] >= 0.1 * values[1]:
                normal = np.array([0.0, 0.0, 1.0])
            bumpy += values[0] > 1e-5
            wanted = np.exp(-np.sum((turn.T @ normal)[:2] ** 2) / 0.2)
            got = (state["episode_sums"].numpy() - before)[world, upright] / 0.02
            assert got == pytest.approx(wanted, abs=5e-3)
    assert bumpy, "some of the ground is not flat"


def test_levels_follow_the_way_and_the_end_of_the_terrain_is_no_fall(rough: Velocity) -> None:
    rough.seed(4)
    rough.reset()
    state = rough.state_dict()
    terrain = rough.ground_terrain
    assert terrain is not None
    state["terrain_levels"][:] = torch.tensor([3, 3, 3, 0])
    kinds = state["terrain_kinds"].numpy()
    # far from the origin, near it, beyond the patches' border, near it on the first level
    ways = [(4.2, 0.0), (0.5, 0.0), (0.0, 0.0), (0.0, 0.5)]
    for world, way in enumerate(ways):
        origin = terrain.origins[int(state["terrain_levels"][world]), kinds[world]]
        state["joint_q"][world, :2] = torch.tensor(origin[:2] + way)
        state["joint_q"][world, 2] = float(origin[2]) + 1.0
    state["joint_q"][2, 0] = -terrain.corner[0] + terrain.border - 0.2
    column = rough.plan.binder.commands["twist"]
    state["memory"][:, column : column + 3] = torch.tensor([1.0, 0.0, 0.0])
    state["memory"][:, column + 3 : column + 9] = 0.0
    state["memory"][:, column + 9] = 100.0
    state["episode_length"][:] = torch.tensor([rough.max_episode_length - 1] * 2 + [5, rough.max_episode_length - 1])
    rough.load_state_dict(state)
    rough.step(torch.zeros(WORLDS, 12))
    assert rough.dones.all() and rough.time_outs.all()
    after = rough.state_dict()
    levels = after["terrain_levels"].tolist()
    assert levels[:2] == [4, 2] and levels[3] == 0
    for world, level in enumerate(levels):
        way = after["joint_q"].numpy()[world, :3] - terrain.origins[level, kinds[world]]
        assert (np.abs(way[:2]) <= 0.5 + 1e-5).all() and 0.287 <= way[2] <= 0.329
