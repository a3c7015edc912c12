"""Recordings, as readers that are not Muster's see them; one that is cut short by SIGKILL, and one for which there is no space."""

from __future__ import annotations

import io
import os
import resource
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from tests.support.waiting import wait_for
from tests.support.worker.in_process import call_worker
from worker.settings.cartpole import CartpoleConfig
from worker.settings.errors import UserError
from worker.tasks.library.cartpole import Cartpole
from worker.telemetry.live_recording import main
from worker.telemetry.recording import Recording, recover
from worker.telemetry.rows import Rows
from worker.telemetry.stage import Stage
from worker.telemetry.tap import Tap, TapReader

torch.set_num_threads(1)
REPOSITORY = Path(__file__).parents[3]
CONFIG = CartpoleConfig(episode_seconds=0.2)
"""Episodes of 12 steps."""
STEPS = 30


class Recorded:
    """A recording of two worlds, with what went into it."""

    def __init__(self, path: Path) -> None:
        task, self.stage = Cartpole(CONFIG, 2, seed=3), Stage(Cartpole, CONFIG, 2)
        tap = Tap(task, 2, rows=64)
        tap.open()
        reading = TapReader(tap)
        image = np.zeros((1, 2, 3, 8, 16), np.uint8)
        image[0, 1, :, 2, 5] = (255, 128, 0)
        recording = Recording(path, self.stage, {"run": "taught", "seed": "3"}, {"job.json": b"{}"})
        self.rows: list[Rows] = []
        for _ in range(STEPS):
            task.step(torch.full((2, 1), 0.1))
            rows = reading.take()
            eye = replace(rows.layout, images=(("eye", 3, 8, 16),))
            self.rows.append(replace(rows, layout=eye, images=image.reshape(1, 2, -1)))
            recording.write(self.rows[-1])
        self.path = recording.finish()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return Recorded(tmp_path_factory.mktemp("recorded") / "two.mcap")


@pytest.fixture(scope="module")
def messages(recorded: Recorded) -> dict[str, list[Any]]:
    """By topic, decoded by mcap-ros2-support, which shares no code with what wrote them."""
    found: dict[str, list[Any]] = {}
    with recorded.path.open("rb") as file:
        for decoded in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found.setdefault(decoded.channel.topic, []).append(decoded.decoded_message)
    return found


def test_joints_and_steps_read_as_the_tap_saw_them(recorded: Recorded, messages: dict[str, list[Any]]) -> None:
    joints, taken = messages["/world_1/joint_states"], messages["/world_1/rl/step"]
    assert len(joints) == len(taken) == STEPS
    stamps = [step.header.stamp.sec * 10**9 + step.header.stamp.nanosec for step in taken]
    np.testing.assert_allclose(np.diff(stamps), 1e9 / 60.0, atol=1.0)  # simulated times on the time of day
    assert stamps[0] > 1_700_000_000 * 10**9
    for number, rows in enumerate(recorded.rows):
        assert joints[number].name == ["slider", "hinge"]
        np.testing.assert_array_equal(joints[number].position, rows.coordinates[0, 1].astype(float))
        np.testing.assert_array_equal(joints[number].velocity, rows.velocities[0, 1].astype(float))
        step = taken[number]
        assert (step.world, step.age, step.done) == (1, rows.mark("age")[0, 1], bool(rows.mark("done")[0, 1]))
        assert step.reward_names == list(Cartpole.config_type().rewards) and step.action_names == ["slider"]
        assert step.observation_names == ["slider_position", "hinge_position", "slider_velocity", "hinge_velocity"]
        np.testing.assert_array_equal(np.float32(step.observation), rows.observations[0, 1])
        np.testing.assert_array_equal(np.float32(step.reward_terms), rows.terms[0, 1])
        assert np.float32(step.reward) == rows.rewards[0, 1]


def test_every_link_has_its_frame_in_a_world_of_its_own(recorded: Recorded, messages: dict[str, list[Any]]) -> None:
    apart = {each.child_frame_id: each for each in messages["/tf_static"][0].transforms}
    assert [(name, each.header.frame_id, each.transform.translation.y) for name, each in apart.items()] == [
        ("world_0", "world", -1.5),
        ("world_1", "world", 1.5),
    ]
    for number, message in enumerate(messages["/tf"]):
        frames = {each.child_frame_id: each for each in message.transforms}
        assert list(frames) == ["world_0/cart", "world_0/pole", "world_1/cart", "world_1/pole"]
        slider, hinge = recorded.rows[number].coordinates[0, 1].tolist()
        pole = frames["world_1/pole"]
        assert pole.header.frame_id == "world_1"
        where, turn = pole.transform.translation, pole.transform.rotation
        # the pole hangs on the cart, 1 m above the ground, and turns about y
        np.testing.assert_allclose([where.x, where.y, where.z], [slider, 0.0, 1.0], atol=1e-6)
        turned = [turn.x, turn.y, turn.z, turn.w]
        np.testing.assert_allclose(turned, [0.0, np.sin(hinge / 2), 0.0, np.cos(hinge / 2)], atol=1e-6)


def test_the_links_shapes_are_in_the_file_as_gltf(messages: dict[str, list[Any]]) -> None:
    (scene,) = messages["/world_0/scene"]
    entities = {entity.frame_id: entity for entity in scene.entities}
    assert set(entities) == {"world_0", "world_0/cart", "world_0/pole"} and entities["world_0/cart"].frame_locked
    (model,) = entities["world_0/cart"].models
    assert model.media_type == "model/gltf-binary" and model.url == ""
    cart = trimesh.load(io.BytesIO(bytes(model.data)), file_type="glb")
    # a box of 0.4 x 0.24 x 0.16 m; glTF's y is up
    np.testing.assert_allclose(cart.bounds, [[-0.2, -0.08, -0.12], [0.2, 0.08, 0.12]], atol=1e-6)


def test_each_episode_has_a_record_and_the_robot_s_file_and_the_job_are_attached(recorded: Recorded) -> None:
    with recorded.path.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        episodes = [each.metadata for each in reader.iter_metadata() if each.name == "episode"]
        attached = {each.name: each.data for each in reader.iter_attachments()}
    assert [(each["world"], each["episode"], each["length"], each["end"]) for each in episodes] == [
        (world, episode, "12", "time_out") for episode in "01" for world in "01"
    ]
    assert {(each["run"], each["seed"], each["complete"]) for each in episodes} == {("taught", "3", "true")}
    rewards = sum(float(rows.rewards[0, 0]) for rows in recorded.rows[:12])
    assert float(episodes[0]["return"]) == pytest.approx(rewards, rel=1e-5)
    assert attached["job.json"] == b"{}"
    assert attached["robot.xml"] == (REPOSITORY / "worker/tasks/library/cartpole.xml").read_bytes()


def test_an_episode_of_which_the_beginning_was_not_seen_is_not_complete(recorded: Recorded, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "late.mcap", recorded.stage, {}, {})
    for rows in recorded.rows[11:25]:  # the first of them ends an episode
        recording.write(rows)
    with recording.finish().open("rb") as file:
        episodes = [each.metadata for each in make_reader(file).iter_metadata() if each.name == "episode"]
    found = [(each["episode"], each["length"], each["complete"]) for each in episodes if each["world"] == "0"]
    assert found == [("0", "1", "false"), ("1", "12", "true")]


def test_rerun_finds_nothing_wrong_with_the_file(recorded: Recorded, tmp_path: Path) -> None:
    rerun = shutil.which("rerun", path=str(Path(sys.executable).parent))
    if rerun is None:
        pytest.skip("rerun-sdk (the extra [viz], 170 MB) is not installed: Rerun has not read the recording")
    checked = subprocess.run([rerun, "mcap", "check", recorded.path], capture_output=True, text=True, check=True)
    assert len([line for line in checked.stdout.splitlines() if line.startswith("ok")]) == 11, checked.stdout
    convert = [rerun, "mcap", "convert", recorded.path, "-o", tmp_path / "two.rrd"]
    subprocess.run(convert, check=True, capture_output=True)
    assert (tmp_path / "two.rrd").stat().st_size > 10_000


def record_for_ever(path: Path) -> None:
    """Until this process is killed, or there is no space."""
    task = Cartpole(CONFIG, 2, seed=3)
    tap = Tap(task, 2)
    tap.open()
    reading = TapReader(tap)
    recording = Recording(path, Stage(Cartpole, CONFIG, 2), {}, {})
    while True:
        task.step(torch.zeros(2, 1))
        recording.write(reading.take())


def test_a_recording_that_was_killed_is_recovered_with_all_that_was_flushed(tmp_path: Path) -> None:
    path, partial = tmp_path / "cut.mcap", tmp_path / "cut.mcap.partial"
    script = "import sys; from pathlib import Path; from tests.training.worker.test_recording import record_for_ever; "
    command = [sys.executable, "-c", f"{script}record_for_ever(Path(sys.argv[1]))", str(path)]
    process = subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.DEVNULL)
    started = wait_for(lambda: partial.exists() and partial.stat().st_size, 60, "the recording's begin")
    size = lambda: partial.stat().st_size  # noqa: E731
    flushed = wait_for(lambda: size() > started + 20_000 and size(), 60, "some steps that were flushed")
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not path.exists()
    with partial.open("ab") as file:  # as a write that was cut off in the middle of a record
        file.write(b"\x06" + (1 << 20).to_bytes(8, "little") + b"cut")
    cut = partial.read_bytes()
    assert len(cut) > flushed
    done = call_worker(main, {}, "--recover", str(partial))
    assert done.returncode == 0, done.stderr
    assert str(path) in done.stdout and partial.read_bytes() == cut
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        counts = summary.statistics.channel_message_counts
        topics = {channel.topic: counts[key] for key, channel in summary.channels.items()}
        assert len([each for each in reader.iter_metadata()]) > 0
    assert topics["/tf"] > 20 and topics["/tf"] - topics["/world_1/rl/step"] in (0, 1)
    assert topics["/world_0/scene"] == 1
    with pytest.raises(UserError, match="exists already; move it away first"):
        recover(partial)


def test_a_recording_for_which_there_is_no_space_says_so_in_one_line_and_keeps_what_it_has(
    recorded: Recorded, tmp_path: Path
) -> None:
    """After another recording, so that no kernel has to be written any more."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(UserError) as refused:
            record_for_ever(tmp_path / "full.mcap")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    output = str(refused.value)
    assert "full.mcap.partial: it can't be written (File too large)" in output and "muster record --recover" in output
    assert "\n" not in output
    made = recover(tmp_path / "full.mcap.partial")
    assert made is not None and made.path == tmp_path / "full.mcap" and made.messages > 20 and not made.losses
    assert not os.path.exists(tmp_path / ".full.mcap.tmp")


def test_a_whole_recording_and_one_without_a_step_are_not_recovered_and_nothing_is_made(
    recorded: Recorded, tmp_path: Path
) -> None:
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap.partial"
    whole.write_bytes(recorded.path.read_bytes())
    Recording(tmp_path / "cut.mcap", recorded.stage, {}, {})  # it has its beginning, and is never finished
    for file, code, words in ((whole, 0, "it is whole already"), (cut, 1, "it ends before the first control step")):
        done = call_worker(main, {}, "--recover", str(file))
        assert done.returncode == code
        (line,) = (done.stdout + done.stderr).splitlines()
        assert f"{file}: {words}" in line
    assert sorted(each.name for each in tmp_path.iterdir()) == ["cut.mcap.partial", "whole.mcap"]


def test_a_file_other_than_a_recording_is_not_recovered(tmp_path: Path) -> None:
    text = tmp_path / "text.mcap.partial"
    text.write_text("no recording")
    for path, words in (
        (text, "it has no readable record of an MCAP file"),
        (tmp_path / "nothing.mcap.partial", "there is no such file"),
        (tmp_path, "it is not a file"),
    ):
        with pytest.raises(UserError, match=words):
            recover(path)
    assert [*tmp_path.iterdir()] == [text]
