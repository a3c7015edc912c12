"""What the live view shows of a recording, read back from Rerun's own file; the page, and what is refused."""

from __future__ import annotations

import http.client
import io
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import rerun
from PIL import Image

from tests.support.refusals import refusal
from tests.training.worker.test_recording import STEPS, Recorded
from worker.settings.errors import UserError
from worker.telemetry.page import ViewerPage
from worker.telemetry.replay import Replay
from worker.telemetry.screen import Screen


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return Recorded(tmp_path_factory.mktemp("recorded") / "two.mcap")


@pytest.fixture(scope="module")
def shown(recorded: Recorded, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The chunks of each entity, of the whole recording."""
    from rerun.chunk import RrdReader

    replay = Replay(recorded.path)
    (part,) = replay.parts()
    file = tmp_path_factory.mktemp("shown") / "two.rrd"
    screen = Screen(file, "two", replay.look, live=False)
    screen.show(part)
    screen.close()
    found: dict[str, Any] = {}
    for chunk in RrdReader(file).stream().to_chunks():
        batch = chunk.to_record_batch()
        rows = pa.table(batch.columns, names=batch.schema.names)
        known = found.setdefault(chunk.entity_path, rows)
        if known is not rows and known.schema == rows.schema:  # what is logged late goes into a chunk of its own
            found[chunk.entity_path] = pa.concat_tables([known, rows])
    return found


def test_a_recording_reads_back_as_the_tap_s_rows(recorded: Recorded) -> None:
    replay = Replay(recorded.path)
    (part,) = replay.parts()
    assert replay.look.links == ("cart", "pole") and set(replay.look.shapes) == {"", "cart", "pole"}
    np.testing.assert_array_equal(replay.look.places, [[0.0, -1.5, 0.0], [0.0, 1.5, 0.0]])
    assert part.steps.tolist() == list(range(1, STEPS + 1)) and not replay.cut and replay.count == STEPS
    for number, rows in enumerate(recorded.rows):
        np.testing.assert_allclose(part.poses[number, :, 0, 0], rows.coordinates[0, :, 0], atol=1e-6)
        np.testing.assert_allclose(part.rewards[number], rows.terms[0].mean(0), rtol=1e-6, atol=1e-7)
    returned = [sum(float(rows.rewards[0, world]) for rows in recorded.rows[:12]) for world in (0, 1)]
    np.testing.assert_allclose([value for _, value in part.returns[:2]], returned, rtol=1e-5)
    assert sum("ended by time_out after 12 steps" in text for _, _, text in part.log) == 4


def test_a_recording_of_which_the_end_is_missing_is_shown_up_to_there(recorded: Recorded, tmp_path: Path) -> None:
    whole = recorded.path.read_bytes()
    cut = tmp_path / "cut.mcap.partial"
    cut.write_bytes(whole[: whole.rindex(b"\x0f" + (4).to_bytes(8, "little"))])  # the record that ends the data
    replay = Replay(cut)
    assert sum(len(part.times) for part in replay.parts()) == STEPS and replay.cut
    cut.write_bytes(whole[:500])
    with pytest.raises(UserError, match="it ends before the first control step"):
        Replay(cut)


def test_a_recording_of_another_program_is_refused_in_one_line(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema(
            "tf2_msgs/msg/TFMessage", "ros2msg", b"geometry_msgs/TransformStamped[] transforms"
        )
        writer.add_message(writer.register_channel("/tf_static", "cdr", schema), 1, b"\0\1\0\0\xff\xff\0\0", 1)
        writer.finish()
    output = refusal(Replay, path, error=UserError)
    assert "it is not a recording of Muster's: its topics have other messages" in output


def test_every_link_of_every_world_is_where_the_simulation_has_it(recorded: Recorded, shown: dict[str, Any]) -> None:
    table = shown["/tf"]
    frames = [each[0] for each in table["Transform3D:child_frame"].to_pylist()]
    assert frames[:5] == ["world_0/cart", "world_0/pole", "world_1/cart", "world_1/pole", "middle"]
    places = np.array([each[0] for each in table["Transform3D:translation"].to_pylist()]).reshape(STEPS, 5, 3)
    turns = np.array([each[0] for each in table["Transform3D:quaternion"].to_pylist()]).reshape(STEPS, 5, 4)
    half = np.sqrt(0.5)
    for number, rows in enumerate(recorded.rows):
        slider, hinge = rows.coordinates[0, 1].tolist()
        np.testing.assert_allclose(places[number, 3], [slider, 1.5, 1.0], atol=1e-6)
        # about y by the hinge, after glTF's y-up was turned to z-up about x
        sin, cos = np.sin(hinge / 2), np.cos(hinge / 2)
        np.testing.assert_allclose(turns[number, 3], [half * cos, half * sin, -half * sin, half * cos], atol=1e-6)
        np.testing.assert_allclose(places[number, 4], places[number, :4].mean(0), atol=1e-6)
    assert {"/worlds/world_0/fixed", "/worlds/world_1/cart", "/worlds/world_1/pole"} <= set(shown)


def test_terms_and_returns_are_drawn(recorded: Recorded, shown: dict[str, Any]) -> None:
    drawn = np.array(shown["/terms"]["Scalars:scalars"].to_pylist())
    np.testing.assert_allclose(drawn, [rows.terms[0].mean(0) for rows in recorded.rows], rtol=1e-6, atol=1e-7)
    assert len(shown["/return/episodes"]["Scalars:scalars"]) == 4


def test_camera_images_are_shown_as_one_picture_of_all_worlds(recorded: Recorded, shown: dict[str, Any]) -> None:
    blobs = shown["/images/eye"]["EncodedImage:blob"].to_pylist()
    assert Replay(recorded.path).look.cameras == ("eye",) and len(blobs) == STEPS
    picture = np.asarray(Image.open(io.BytesIO(bytes(blobs[7][0]))))
    assert picture.shape == (8, 32, 3) and picture[2, 16 + 5].tolist() == [255, 128, 0] and picture.sum() == 383


def test_the_page_is_for_this_machine_alone_and_reaches_no_other() -> None:
    with ViewerPage(None, "64MB") as page:
        with urllib.request.urlopen(f"{page.url}/") as answer:
            policy, text = answer.headers["Content-Security-Policy"], answer.read().decode()
        assert "connect-src 'self' blob: data:" in policy
        assert "fonts.googleapis.com" not in text and "re_viewer.js" in text
        request = urllib.request.Request(f"{page.url}/", headers={"Host": "evil.example"})
        for refused, code in ((request, 403), (f"{page.url}/etc/passwd", 404)):
            with pytest.raises(urllib.error.HTTPError) as error:
                urllib.request.urlopen(refused)
            assert error.value.code == code
        port = int(page.url.rpartition(":")[2])
        with pytest.raises(UserError, match=f"--port {port}: the page can't be served there"):
            ViewerPage(port, "64MB")
        page._process.kill()
        page._process.wait()
        with pytest.raises(UserError, match=r"the viewer's server ended \(signal 9\)"):
            page.check()
    assert not page._home.exists()


def test_the_stream_comes_through_the_port_of_the_page_also_at_a_tunnel_s_other_end() -> None:
    """As the viewer in a browser asks for it, by gRPC-web, and finds an address of this page alone."""
    with ViewerPage(None, "64MB") as page:
        stream = rerun.RecordingStream("tunnel")
        stream.connect_grpc(page.server)
        stream.log("number", rerun.Scalars(1.0))
        stream.flush()
        port = int(page.url.rpartition(":")[2])
        assert port in range(9090, 9100)
        read = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"
        headers = {
            "Content-Type": "application/grpc-web+proto",
            "Host": "localhost:1234",
            "Origin": "http://localhost:1234",
        }
        for changed, code in (({}, 200), ({"Origin": "http://evil.example"}, 403), ({"Host": "evil.example"}, 403)):
            asking = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
            asking.request("POST", read, b"\0\0\0\0\0", {**headers, **changed})
            answer = asking.getresponse()
            assert answer.status == code
            if code == 200:
                seen = b""
                while b"number" not in seen:
                    seen += answer.read1(1 << 16)
            asking.close()
        asking = http.client.HTTPConnection("127.0.0.1", port)
        asking.request("GET", "/", headers={"Host": "localhost:1234"})
        where = asking.getresponse().headers["Location"]
        assert where.startswith("http://localhost:1234/?url=rerun%2Bhttp%3A%2F%2Flocalhost%3A1234%2Fproxy&")
        stream.disconnect()


def test_without_the_extra_one_line_names_the_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worker.telemetry.page.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'muster\[viz\]'"):
        ViewerPage(None, "64MB")
