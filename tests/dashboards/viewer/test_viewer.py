import subprocess
import sys
import time
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import rerun as rr
from PIL import Image

from dashboards import viewer
from dashboards.errors import ViewerError
from dashboards.identity import COLOURS, MatchPlayer
from dashboards.replay import Replay, distances, replay
from dashboards.viewer.camera import framed_radius
from dashboards.viewer.headless import headless_viewer
from dashboards.viewer.panels import blueprint
from tests.dashboards.cars import STEPS, XML, cars


@pytest.fixture(scope="module")
def match():
    return cars()


@pytest.fixture(scope="module")
def columns(match, tmp_path_factory):
    path = tmp_path_factory.mktemp("rrd") / "match.rrd"
    viewer.write_rrd(match, path)
    return written(path)


def written(path):
    """What the rrd file holds: (entity path, component) -> one entry per row, and the timelines of its chunk."""
    reader = rr.chunk.RrdReader(path)
    found = {}
    for store in reader.recordings():
        for chunk in reader.stream(store=store).to_chunks():
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                found[chunk.entity_path, name] = batch.column(name).to_pylist()
    return found


def truth(match):
    """World poses of every body and geom at every step, from MuJoCo."""
    model = mujoco.MjModel.from_xml_string(match.xml)
    data = mujoco.MjData(model)
    for qpos in match.qpos:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        yield model, data


@pytest.mark.parametrize("name", ["blue/0/chassis", "red/0/chassis", "blue/0/mast", "red/0/mast"])
def test_bodies_are_where_mujoco_has_them(match, columns, name):
    translation = np.array(columns[f"/world/{name}", "Transform3D:translation"])[:, 0]
    xyzw = np.array(columns[f"/world/{name}", "Transform3D:quaternion"])[:, 0]
    expected = [(data.body(name).xpos.copy(), data.body(name).xquat[[1, 2, 3, 0]]) for _, data in truth(match)]
    np.testing.assert_allclose(translation, [pose for pose, _ in expected], atol=1e-5)
    np.testing.assert_allclose(xyzw, [turn for _, turn in expected], atol=1e-6)
    assert np.ptp(translation[:, 0]) > 0.05  # it moved


def test_both_timelines_are_there_in_steps_and_seconds(match, columns):
    assert columns["/world/blue/0/chassis", "step"] == list(range(STEPS))
    seconds = [duration.total_seconds() for duration in columns["/world/blue/0/chassis", "sim_time"]]
    np.testing.assert_allclose(seconds, match.time, atol=1e-6)


def test_capsules_are_centred_as_in_mujoco(match, columns):
    model, data = next(truth(match))
    chassis, bumper = data.body("blue/0/chassis"), data.geom("blue/0/bumper")
    half = model.geom("blue/0/bumper").size[1]
    path = "/world/blue/0/chassis/capsule"
    start = np.array(columns[path, "Capsules3D:translations"][0][0])
    world = chassis.xpos + chassis.xmat.reshape(3, 3) @ start
    np.testing.assert_allclose(world, bumper.xpos - half * bumper.xmat.reshape(3, 3)[:, 2], atol=1e-5)
    assert columns[path, "Capsules3D:lengths"][0] == [pytest.approx(2 * half)]


def test_colours_come_from_the_geom_or_its_material(columns):
    box = columns["/world/red/0/chassis/box", "Boxes3D:colors"][0]
    capsule = columns["/world/red/0/chassis/capsule", "Capsules3D:colors"][0]
    assert [f"{colour:08x}" for colour in (*box, *capsule)] == ["ff4e42ff", "ff1a1aff"]


def test_collision_geoms_are_hidden_and_still_things_do_not_move(columns):
    assert len(columns["/world/blue/0/chassis/box", "Boxes3D:half_sizes"][0]) == 1
    assert columns["/world/post", "Transform3D:translation"] == [[[3, 3, 0]]]
    assert ("/world/post", "step") not in columns
    assert ("/world/ground/plane", "Boxes3D:half_sizes") in columns


def test_the_ring_has_its_radius_at_every_step(match, columns):
    strips = np.array([row[0] for row in columns["/world/markers/ring", "LineStrips3D:strips"]])
    assert strips.shape == (STEPS, 65, 3)
    radii = np.hypot(strips[..., 0], strips[..., 1])
    np.testing.assert_allclose(radii, np.repeat(match.markers["ring"][:, 2:], 65, axis=1), atol=1e-5)


def test_a_ring_that_stands_still_is_written_once(match, tmp_path):
    still = replace(match, markers={"ring": np.tile([0.0, 0.0, 1.5], (STEPS, 1))})
    viewer.write_rrd(still, tmp_path / "still.rrd")
    reader = rr.chunk.RrdReader(tmp_path / "still.rrd")
    chunks = [chunk for store in reader.recordings() for chunk in reader.stream(store=store).to_chunks()]
    rows = [chunk.num_rows for chunk in chunks if chunk.entity_path == "/world/markers/ring" and not chunk.is_static]
    assert rows == [1]


def test_segments_and_balls_are_where_they_were_told(match, tmp_path):
    along = np.linspace(0, 1, STEPS)
    told = {
        "laser": np.stack([0 * along, 0 * along, 0 * along + 0.1, along, 2 * along, 3 * along], axis=1),
        "zone": np.stack([4 + along, 0 * along, 0 * along + 3, 1.5 - along], axis=1),
        "goal": np.tile([9.0, 0.0, 3.0, 0.2], (STEPS, 1)),
    }
    kinds = {"laser": "segment", "zone": "sphere", "goal": "ball"}
    shown = replace(match, header=replace(match.header, marker_kinds=kinds), markers=told)
    viewer.write_rrd(shown, tmp_path / "shown.rrd")
    reader = rr.chunk.RrdReader(tmp_path / "shown.rrd")
    found = {}
    for chunk in (chunk for store in reader.recordings() for chunk in reader.stream(store=store).to_chunks()):
        batch = chunk.to_record_batch()
        found |= {(chunk.entity_path, name): batch.column(name).to_pylist() for name in batch.schema.names}
    strips = np.array([row[0] for row in found["/world/markers/laser", "LineStrips3D:strips"]])
    np.testing.assert_allclose(strips.reshape(STEPS, 6), told["laser"], atol=1e-6)
    centres = np.array([row[0] for row in found["/world/markers/zone", "Ellipsoids3D:centers"]])
    halves = np.array([row[0] for row in found["/world/markers/zone", "Ellipsoids3D:half_sizes"]])
    np.testing.assert_allclose(centres, told["zone"][:, :3], atol=1e-6)
    np.testing.assert_allclose(halves, np.repeat(told["zone"][:, 3:], 3, axis=1), atol=1e-6)
    assert found["/world/markers/goal", "Ellipsoids3D:centers"] == [[[9, 0, 3]]]  # once, for it stands still
    assert replay(shown).radius == pytest.approx(1.2 * 9.0)  # a goal far from all bodies is in the picture
    line = {"line": np.tile([6.0, -5.0, 0.0, 6.0, 5.0, 0.0], (STEPS, 1))}
    crossed = replace(shown, header=replace(shown.header, marker_kinds={"line": "segment"}), markers=line)
    assert replay(crossed).radius == pytest.approx(1.2 * 6.0)  # and so is the middle of a line that never moves


def test_reward_score_events_and_header_are_told(match, columns):
    assert [row[0] for row in columns["/reward/red", "Scalars:scalars"]] == match.reward[:, 1].tolist()
    assert [row[0] for row in columns["/score/blue", "Scalars:scalars"]] == match.score[:, 0].tolist()
    assert columns["/events", "step"] == [30, 60, 80]
    assert columns["/events", "TextLog:text"] == [["contact"], ["red/0 leaves the ring"], ["contact"]]
    text = columns["/header", "TextDocument:text"][0][0]
    assert "# win blue" in text
    assert "| red@8 |  |  | red, square | 0 | red/0 |" in text


CAST = (MatchPlayer("red@8", COLOURS[1], "main", "1012 ± 30"), MatchPlayer("pusher", COLOURS[4], "fixed"))


def test_a_player_keeps_its_colour_on_the_other_side(match):
    model = replay(match, CAST).model
    chassis, bumper = (model.geom(i).id for i in (model.body("blue/0/chassis").geomadr[0], "blue/0/bumper"))
    np.testing.assert_allclose(model.geom_rgba[chassis, :3], np.array(COLOURS[1]) / 255, atol=1e-6)
    theirs = model.body("red/0/chassis").geomadr[0]
    np.testing.assert_allclose(model.geom_rgba[theirs, :3], np.array(COLOURS[4]) / 255, atol=1e-6)
    np.testing.assert_allclose(model.geom_rgba[bumper, :3], replay(match).model.geom_rgba[bumper, :3])  # nobody's


def test_over_each_robot_stands_who_plays_it_and_round_it_the_shape_of_its_side(match, tmp_path):
    viewer.write_rrd(match, tmp_path / "cast.rrd", CAST)
    found = written(tmp_path / "cast.rrd")
    assert found["/world/labels/blue/0", "Points3D:labels"] == [["red@8 · 1012 · main"]]
    assert found["/world/labels/red/0", "Points3D:labels"] == [["pusher · fixed"]]
    assert [len(found[f"/world/sides/{side}/0", "LineStrips3D:strips"][0][0]) for side in ("blue", "red")] == [49, 5]
    at = np.array(found["/world/sides/red/0", "Transform3D:translation"])[:, 0]
    np.testing.assert_allclose(at[:, :2], replay(match).xpos[:, replay(match).model.body("red/0/chassis").id, :2], 1e-4)
    assert "| red@8 | main | 1012 ± 30 | blue, circle | 1 | blue/0 |" in found["/header", "TextDocument:text"][0][0]
    assert found["/score/blue", "SeriesLines:names"] == [["red@8 (blue)"]]


def test_how_far_each_team_is_from_the_edge_is_a_curve(match, columns):
    x = replay(match).xpos[:, replay(match).model.body("red/0/chassis").id, 0]
    edge = [row[0] for row in columns["/distance/edge/red", "Scalars:scalars"]]
    np.testing.assert_allclose(edge, match.markers["ring"][:, 2] - np.abs(x), atol=1e-3)


def test_how_far_each_team_is_from_what_moves_and_is_nobodys(match):
    ball = '<body name="ball/ball" pos="0 0 1"><freejoint/><geom type="sphere" size=".1" mass="1"/></body>'
    xml = match.xml.replace("</worldbody>", f"{ball}</worldbody>")
    qpos = np.hstack([match.qpos, np.tile([0.0, 0, 1, 1, 0, 0, 0], (STEPS, 1))])
    played = replace(match, xml=xml, qpos=qpos)
    far = distances(played, replay(played))
    assert set(far) == {"edge", "ball"}
    assert far["ball"][0] == pytest.approx(np.hypot(1, 0.83) * np.ones(2), abs=0.05)


def test_terms_are_series_of_their_team_and_events_lanes_of_the_time_line(match, columns):
    assert [row[0] for row in columns["/terms/red/push", "Scalars:scalars"]] == match.terms["push"][:, 1].tolist()
    assert [row[0] for row in columns["/terms/blue/effort", "Scalars:scalars"]] == [-0.25] * STEPS
    assert [row[0] for row in columns["/value/blue", "Scalars:scalars"]] == match.values["blue"].tolist()
    assert not [path for path, _ in columns if path.startswith("/value/red")]  # nobody judged for red
    assert columns["/lanes/contact", "step"] == [30, 31, 80, 81]
    assert columns["/lanes/contact", "StateChange:state"] == [["contact"], [""], ["contact"], [""]]
    (lane,) = {path for path, _ in columns if path.startswith("/lanes/red")}
    assert columns[lane, "step"] == [60, 61]


def test_a_match_without_terms_or_events_is_drawn_without_them(match, tmp_path):
    viewer.write_rrd(replace(match, terms={}, values={}, events=()), tmp_path / "plain.rrd")
    reader = rr.chunk.RrdReader(tmp_path / "plain.rrd")
    paths = {chunk.entity_path for store in reader.recordings() for chunk in reader.stream(store=store).to_chunks()}
    assert {path.split("/")[1] for path in paths} >= {"world", "score", "reward", "header"}
    assert not {path.split("/")[1] for path in paths} & {"terms", "value", "events", "lanes"}


def test_a_name_under_another_bodys_name_does_not_inherit_its_motion(match, tmp_path):
    nested = replace(match, xml=XML.replace("blue/0/mast", "blue/0/chassis/mast"))
    viewer.write_rrd(nested, tmp_path / "nested.rrd")
    reader = rr.chunk.RrdReader(tmp_path / "nested.rrd")
    paths = {chunk.entity_path for store in reader.recordings() for chunk in reader.stream(store=store).to_chunks()}
    assert r"/world/blue\/0\/chassis\/mast" in paths
    assert not any(path.startswith("/world/blue/0/chassis") for path in paths)


def pixels(path):
    """Where the 3D part of the picture is red, blue and the ring's amber: masks (h, w)."""
    with Image.open(path) as image:
        rgb = np.asarray(image.convert("RGB")).astype(int)[40:, : image.width * 7 // 10]
    r, g, b = rgb[..., 0], rgb[..., 1], rgb[..., 2]
    return (
        (r > 2 * g) & (r > 2 * b) & (r > 80),
        (b > 1.5 * g) & (b > 2 * r) & (b > 80),
        (r > 200) & (g > 150) & (b < 120),
    )


def test_pictures_show_both_teams_and_the_match_going_on(match, tmp_path, graphics):
    early, late = tmp_path / "early.png", tmp_path / "late.png"
    viewer.screenshot(match, early, at_seconds=0, size=(1000, 600))
    viewer.screenshot(match, late, at_seconds=2.0, size=(1000, 600))

    widths = []
    for path in (early, late):
        with Image.open(path) as image:
            assert image.size == (1000, 600)
        red, blue, amber = pixels(path)
        assert red.sum() > 500
        assert blue.sum() > 500
        assert np.flatnonzero(red.any(0)).mean() > np.flatnonzero(blue.any(0)).mean()  # red stands on the right
        widths.append(np.ptp(np.flatnonzero(amber.any(0))))
    assert widths[1] / widths[0] == pytest.approx(1.2 / 2, abs=0.08)  # nearly the ratio of the rings' radii


def test_show_hands_the_match_to_a_viewer_that_already_runs(match, monkeypatch, graphics):
    monkeypatch.setenv("DISPLAY", ":0")  # the viewer below needs none
    with headless_viewer((400, 300)) as client:
        viewer.show(match, port=int(client.url.split(":")[-1].split("/")[0]))
        deadline = time.monotonic() + 20
        while not (recordings := client.state().recordings) and time.monotonic() < deadline:
            time.sleep(0.1)
        timelines = {timeline.name: timeline for timeline in recordings[0].timelines}
        assert {view.name for view in client.state().views} >= {
            "sumo",
            "Distance to edge, m",
            "Score",
            "Events",
            "Terms of blue",
            "Time line",
        }
    assert (timelines["step"].start, timelines["step"].end) == (0, STEPS - 1)


def test_what_starts_high_above_a_small_ring_is_seen_from_farther_away(match):
    raised = match.qpos.copy()
    raised[:, 2] += 1.5
    usual, above = (replay(each) for each in (match, replace(match, qpos=raised)))
    assert framed_radius(usual, np.zeros(3), usual.radius) == usual.radius
    worlds = [blueprint(rr, match, each).root_container.contents[0] for each in (usual, above)]
    eyes = [world.properties["EyeControls3D"].position.as_arrow_array().to_pylist() for world in worlds]
    away = np.linalg.norm(np.reshape(eyes, (2, 3)), axis=1)
    assert away[0] < away[1] < 2.01 * away[0]


def test_errors_say_what_to_type(match, tmp_path, monkeypatch):
    with pytest.raises(ViewerError, match=r"no second 9 in this match; it has 0\.02 to 2"):
        viewer.screenshot(match, tmp_path / "x.png", at_seconds=9)
    unknown = replace(match, header=replace(match.header, marker_kinds={"ring": "hexagon"}))
    with pytest.raises(ViewerError, match="marker 'ring' is a 'hexagon'; the viewer draws: 'circle', 'segment',"):
        viewer.write_rrd(unknown, tmp_path / "x.rrd")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ViewerError, match=r"no display here; use --web .* --save .* or --shot"):
        viewer.show(match)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ViewerError, match=r"pip install 'robot-league\[view\]'"):
        viewer.write_rrd(match, tmp_path / "x.rrd")


def test_importing_the_viewer_loads_neither_rerun_nor_mujoco():
    program = "import sys, dashboards.viewer; print([m for m in ('rerun', 'mujoco', 'pandas') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_a_robot_without_a_label_keeps_the_shape_of_its_side(match, tmp_path, monkeypatch):
    monkeypatch.setattr(Replay, "labelled", property(lambda scene: scene.robots[:1]))
    viewer.write_rrd(match, tmp_path / "cast.rrd", CAST)
    found = written(tmp_path / "cast.rrd")
    assert {path for path, what in found if what == "Points3D:labels"} == {"/world/labels/blue/0"}
    assert ("/world/sides/red/0", "LineStrips3D:strips") in found
