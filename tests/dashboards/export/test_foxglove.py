"""An export for other viewers, read back by MCAP's and rerun's own readers."""

import io
import subprocess
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from dashboards.export.foxglove import write_foxglove
from dashboards.viewer.headless import executable
from storage.errors import StorageError
from storage.recordings.recording import to_bytes
from tests.dashboards.cars import STEPS, cars


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("foxglove") / "match.mcap"
    write_foxglove(cars(), path)
    return path


def messages(file, topic: str) -> list:
    reader = make_reader(io.BytesIO(file.read_bytes()), validate_crcs=True, decoder_factories=[DecoderFactory()])
    return [each.decoded_message for each in reader.iter_decoded_messages(topics=topic)]


def test_every_body_is_where_mujoco_has_it(file):
    match, moves = cars(), messages(file, "/tf")
    assert len(moves) == STEPS
    model = mujoco.MjModel.from_xml_string(match.xml)
    data = mujoco.MjData(model)
    data.qpos[:] = match.qpos[70]
    mujoco.mj_kinematics(model, data)
    for each in moves[70].transforms:
        body = data.body(each.child_frame_id)
        np.testing.assert_allclose([each.translation.x, each.translation.y, each.translation.z], body.xpos, atol=1e-9)
        turned = [each.rotation.w, each.rotation.x, each.rotation.y, each.rotation.z]
        np.testing.assert_allclose(turned, body.xquat, atol=1e-9)
    assert moves[70].transforms[0].timestamp.ToSeconds() == 1


def test_shapes_stand_in_the_frames_of_their_bodies_with_who_plays(file):
    (scene,) = messages(file, "/scene")
    entities = {entity.id: entity for entity in scene.entities}
    car = entities["red/0/chassis"]
    assert car.frame_id == "red/0/chassis"
    assert car.frame_locked
    assert [(cube.size.x, cube.size.y, cube.size.z) for cube in car.cubes] == [(0.6, 0.36, 0.16)]
    assert len(car.cylinders) == 5  # four wheels, the bumper's middle
    assert len(car.spheres) == 2  # the bumper's ends
    assert len(car.triangles[0].points) == 4
    assert [text.text for text in car.texts] == ["red@8"]
    assert {transform.child_frame_id for transform in messages(file, "/tf")[0].transforms} == entities.keys() - {
        "world"
    }


def test_markers_change_and_events_are_told(file):
    rings = [update.entities[0].lines[0].points[0] for update in messages(file, "/markers")]
    assert np.hypot(rings[0].x, rings[0].y) == pytest.approx(2.0)
    assert np.hypot(rings[-1].x, rings[-1].y) == pytest.approx(1.2)
    assert [log.message for log in messages(file, "/events")] == ["contact", "red/0 leaves the ring", "contact"]


def test_the_numbers_of_the_recording_can_be_plotted(file):
    match, steps = cars(), messages(file, "/match/step")
    assert [step.reward[1] for step in steps] == match.reward[:, 1].tolist()
    assert [{each.name: each.values[0] for each in step.values} for step in steps] == [
        {"blue": value} for value in match.values["blue"].tolist()
    ]


def test_rerun_finds_it_sound_and_its_urdf_has_every_body(file, tmp_path):
    recording = tmp_path / "recording.mcap"
    recording.write_bytes(to_bytes(cars(), cars()))
    for each in (file, recording):
        checked = subprocess.run([executable(), "mcap", "check", each], capture_output=True, text=True, check=False)
        assert checked.returncode == 0, checked.stdout + checked.stderr
    (raw,) = [
        message.data for _, channel, message in make_reader(io.BytesIO(file.read_bytes())).iter_messages()
        if channel.topic == "/robot_description"
    ]  # fmt: skip
    links = {link.get("name") for link in ElementTree.fromstring(raw[8:-1].decode()).iter("link")}
    assert links == {"world", "post", *(f"{side}/0/{part}" for side in ("blue", "red") for part in ("chassis", "mast"))}


def test_it_is_never_written_over_a_file(file):
    before = file.read_bytes()
    with pytest.raises(StorageError, match="exists already"):
        write_foxglove(cars(), file)
    assert file.read_bytes() == before
