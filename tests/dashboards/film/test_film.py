"""Pictures and films without a graphics driver: bodies where they are, in their players' colours, moment by moment."""

import os
import signal
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from dashboards.errors import ViewerError
from dashboards.film import film
from dashboards.film.film import Film, save_film
from dashboards.identity import COLOURS, MatchPlayer
from dashboards.replay import Replay
from tests.dashboards.cars import cars

SIZE = (320, 200)


@pytest.fixture(scope="module")
def shown():
    return Film(cars(), SIZE)


def coloured(picture, colour, near: int = 40) -> np.ndarray:
    """(rows, columns) of the pixels that have a colour in some light."""
    rgb = np.asarray(picture).astype(float)
    light = rgb.max(axis=-1, keepdims=True) / max(colour)
    return np.argwhere((np.abs(rgb - light * np.array(colour)).max(axis=-1) < near) & (light[..., 0] > 0.4))


def below(picture, colour) -> np.ndarray:
    """The same without the caption at the top."""
    found = coloured(picture, colour)
    return found[found[:, 0] > 30]


def middle(shown: Film, side: int, step: int) -> np.ndarray:
    """Row and column at which the base of a side's car is seen."""
    at = shown.scene.xpos[step, shown.scene.robots[side].body]
    x, y, _ = shown.camera.project(at[None])[0] / film.SUPERSAMPLING
    return np.array([y, x])


@pytest.mark.parametrize("step", [0, 99])
@pytest.mark.parametrize("side", [0, 1])
def test_cars_are_drawn_where_they_are_in_the_colours_of_who_plays(shown, side, step):
    picture = shown.picture(step)
    assert picture.size == SIZE
    found = below(picture, COLOURS[side])
    away = np.linalg.norm(found - middle(shown, side, step), axis=1)
    assert (away < 15).sum() > 40


def test_a_player_on_the_other_side_takes_its_colour_along():
    match = cars()
    swapped = Film(match, SIZE, (MatchPlayer("red@8", COLOURS[1]), MatchPlayer("blue@16", COLOURS[0])))
    found = below(swapped.picture(0), COLOURS[1])
    assert (np.linalg.norm(found - middle(swapped, 0, 0), axis=1) < 15).sum() > 40


@pytest.mark.parametrize("length", [1, 12, 30])
def test_long_names_fit_at_the_top(length):
    size = (480, 300)
    names = ("b" * length, "r" * length)
    players = [MatchPlayer(f"{name}@8", COLOURS[i], "", "1012 ± 30") for i, name in enumerate(names)]
    top = np.asarray(Film(cars(), size, players, labels=False).picture(0))[:30]
    for colour in COLOURS[:2]:
        found = coloured(top, colour)
        assert len(found) > 20
        assert found[:, 1].max() < size[0] - 5


def test_robots_without_a_label_are_drawn_as_in_a_film_without_labels(monkeypatch):
    unlabelled = np.asarray(Film(cars(), (320, 200), labels=False).picture(10))
    assert (np.asarray(Film(cars(), (320, 200)).picture(10)) != unlabelled).any()
    monkeypatch.setattr(Replay, "labelled", ())
    np.testing.assert_array_equal(np.asarray(Film(cars(), (320, 200)).picture(10)), unlabelled)


def test_the_ring_shrinks_and_cars_throw_shadows(shown):
    def width(step: int) -> int:
        found = coloured(shown.picture(step), (255, 200, 60), 25)
        return int(np.ptp(found[:, 1]))

    assert width(99) / width(0) == pytest.approx(1.2 / 2, abs=0.1)
    painter = shown._raycaster
    painter.pose(shown.recording.qpos[0])
    dark = np.argwhere((painter.ground() < painter._background - 1).all(axis=-1)) / film.SUPERSAMPLING
    assert len(dark) > 100
    for side in (0, 1):
        assert np.linalg.norm(dark - middle(shown, side, 0), axis=1).min() < 20


def test_what_is_behind_the_eye_or_not_a_number_is_left_out():
    match = cars()
    qpos = match.qpos.copy()
    qpos[5, :3], qpos[6, 7:10] = (0, -100, 5), np.nan
    shown = Film(replace(match, qpos=qpos), SIZE)
    assert len(below(shown.picture(5), COLOURS[1])) > 40
    assert len(below(shown.picture(6), COLOURS[0])) > 40


def test_close_up_robots_are_larger_and_never_leave_the_picture():
    match = cars()
    near, far = Film(match, SIZE, close=True), Film(match, SIZE)
    assert len(below(near.picture(50), COLOURS[0])) > 1.3 * len(below(far.picture(50), COLOURS[0]))
    for robot in near.scene.robots:
        seen = near.camera.project(near.scene.xpos[:, robot.body])[:, :2] / film.SUPERSAMPLING
        assert (seen > 0).all()
        assert (seen < SIZE).all()


@pytest.mark.parametrize("kind", [".gif", ".webp"])
def test_a_film_has_its_pictures_at_its_rate(shown, tmp_path, kind):
    told = []
    save_film(shown, tmp_path / f"m{kind}", 10, (0.5, 1.0), lambda *so_far: told.append(so_far))
    with Image.open(tmp_path / f"m{kind}") as moving:
        assert moving.size == SIZE
        moving.load()  # a .webp knows how long a picture stays when it has been read
        assert moving.info["duration"] == 100
        if kind == ".webp":  # a .gif keeps pictures that are alike as one
            assert moving.n_frames in (6, 15)
        first = np.asarray(moving.convert("RGB")).astype(int)
        moving.seek(4)
        assert (np.abs(np.asarray(moving.convert("RGB")).astype(int) - first).max(axis=-1) > 60).sum() > 50
    assert told[-1] == (15, 15)  # half a second, and the last picture for one
    assert [path.name for path in tmp_path.iterdir()] == [f"m{kind}"]


def test_an_mp4_is_read_back_by_ffmpeg(shown, tmp_path):
    save_film(shown, tmp_path / "m.mp4", 10, (0.5, 1.0), lambda *_: None)
    command = [film.ffmpeg(), "-v", "error", "-i", tmp_path / "m.mp4", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    pictures = np.frombuffer(raw, np.uint8).reshape(-1, SIZE[1], SIZE[0], 3)
    assert len(pictures) == 15
    assert len(coloured(pictures[0], COLOURS[1])) > 40


def test_what_cannot_be_made_is_told_and_leaves_nothing(shown, tmp_path, monkeypatch):
    with pytest.raises(ViewerError, match=r"\*\.mp4, \*\.webm, \*\.gif, \*\.webp, not m\.avi"):
        save_film(shown, tmp_path / "m.avi", 10, (0, 1), lambda *_: None)
    with pytest.raises(ViewerError, match=r"no second 9 in this match; it has 0\.02 to 2"):
        film.save_picture(shown, tmp_path / "m.png", 9)
    with pytest.raises(ViewerError, match="no second -5 in this match"):
        save_film(shown, tmp_path / "m.gif", 10, (-5, 1), lambda *_: None)
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(ViewerError, match=r"pip install 'robot-league\[video\]'"):
        save_film(shown, tmp_path / "m.mp4", 10, (0, 1), lambda *_: None)
    assert not list(tmp_path.iterdir())


def test_ctrl_c_ends_ffmpeg_too(shown, tmp_path, monkeypatch):
    encoder = tmp_path / "ffmpeg"
    encoder.write_text(
        f"#!/bin/sh\necho $$ > {tmp_path}/pid\ncat > /dev/null\nsleep 0.5\nkill -INT {os.getpid()}\nexec sleep 30\n"
    )
    encoder.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            save_film(shown, tmp_path / "m.webm", 10, (0, 0.2), lambda *_: None)
    finally:
        signal.signal(signal.SIGINT, before)
    with pytest.raises(ProcessLookupError):  # neither running nor a zombie
        os.kill(int((tmp_path / "pid").read_text()), 0)
    assert not (tmp_path / "m.webm").exists()


def test_what_starts_high_above_a_small_ring_is_within_the_picture():
    match = cars()
    raised = match.qpos.copy()
    raised[:, 2] += 1.5
    shown, usual = Film(replace(match, qpos=raised), SIZE), Film(match, SIZE)
    row, _ = middle(shown, 0, 0)
    assert 0 < row < SIZE[1]
    away = [np.linalg.norm(each.camera.eye) for each in (usual, shown)]
    assert away[0] < away[1] < 2.01 * away[0]
