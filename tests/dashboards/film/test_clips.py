"""Clips of matches: small, drawn once, shown by what they hold."""

import re
import subprocess
import time
from dataclasses import replace

import pytest

from dashboards.errors import ViewerError
from dashboards.film import clips as module
from dashboards.film.clips import MAX_BYTES, Clips
from dashboards.film.film import ffmpeg
from dashboards.identity import COLOURS, MatchPlayer
from storage.errors import StorageError
from tests.dashboards.cars import cars


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    clips = Clips(tmp_path_factory.mktemp("clips") / "new")
    return clips, clips.make(cars())


def about(path) -> str:
    return subprocess.run([ffmpeg(), "-i", path], capture_output=True, text=True, check=False).stderr


def test_a_clip_is_small_and_in_a_format_of_all_browsers(made):
    _, clip = made
    assert clip.path.stat().st_size <= MAX_BYTES
    text = about(clip.path)
    assert "matroska,webm" in text
    assert re.search(r"Video: vp9.* yuv420p.* 480x300", text)
    assert re.search(r"Duration: 00:00:0[23]\.", text)  # two seconds, and the last picture for one
    assert (clip.begin, clip.end) == pytest.approx((0.02, 2.0), abs=0.02)


def test_it_is_drawn_once_for_each_match_and_each_way_to_draw_it(made, monkeypatch):
    clips, clip = made
    before = clip.path.stat().st_mtime_ns
    monkeypatch.setattr(module, "Film", None)  # nothing is drawn
    assert clips.make(cars()) == clip
    assert clip.path.stat().st_mtime_ns > before  # it has been used
    assert clips.find(cars(), [MatchPlayer(name, COLOURS[0]) for name in ("blue@16", "red@8")]) is None
    assert clips.find(replace(cars(), qpos=cars().qpos + 1)) is None


def test_of_a_long_match_the_end_is_shown(made, monkeypatch):
    monkeypatch.setattr(module, "SECONDS", 0.5)
    clip = Clips(made[0].folder).make(cars())
    assert (clip.begin, clip.end) == pytest.approx((1.5, 2.0))
    assert re.search(r"Duration: 00:00:01\.", about(clip.path))


def test_a_clip_that_is_too_large_is_made_again_with_fewer_bits(tmp_path, monkeypatch):
    tried = []
    real = module.save_film

    def seen(*given):
        tried.append(given[-1])
        real(*given)

    monkeypatch.setattr(module, "save_film", seen)
    monkeypatch.setattr(module, "MAX_BYTES", 10_000)
    monkeypatch.setattr(module, "BIT_RATES", (800_000, 12_000))
    clip = Clips(tmp_path).make(cars())
    assert tried == [800_000, 12_000]
    assert clip.path.stat().st_size < 20_000


def test_clips_used_longest_ago_are_removed(made, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "KEPT", 2)
    for number in range(3):
        (tmp_path / f"{number}.webm").write_bytes(b"old")
        time.sleep(0.02)
    clip = Clips(tmp_path).make(cars())
    assert {path.name for path in tmp_path.iterdir()} == {"2.webm", clip.path.name}


def test_what_is_missing_is_told_in_a_line(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match="Cannot keep clips in"):
        Clips(tmp_path / "file" / "clips").make(cars())
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(ViewerError, match=r"pip install 'robot-league\[video\]'"):
        Clips(tmp_path / "clips").make(cars())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
