"""Clips of a league's matches: which are made, where they are kept, and what is told without any."""

import time

import pytest

from dashboards.errors import ViewerError
from dashboards.film import clips as films
from league.matches.match_clips import BackgroundClips, make_clips
from league.queries.query import Open
from league.queries.recordings import highlights
from storage.errors import StorageError
from storage.recordings.recording import to_bytes
from storage.store import Store
from tests.dashboards.cars import cars
from tests.league.leagues import filled, finish, match


@pytest.fixture
def store(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOT_LEAGUE_CACHE", str(tmp_path / "cache"))
    with filled(tmp_path / "league-data") as store:
        yield store


def record(store: Store, a: str, b: str, wins: int, losses: int) -> int:
    """File a match with the recording of the cars; return its number."""
    finish(store, matches=[match(a, b, wins, losses, recording=store.blobs.put(to_bytes(cars())))])
    return store.last_match("cup")


def until(there) -> None:
    deadline = time.monotonic() + 120
    while not there():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_the_newest_comes_first_and_no_match_twice(store):
    even = record(store, "blue@1", "red@1", 33, 31)
    record(store, "blue@0", "red@0", 30, 34)
    finish(store, matches=[match(f"{name}@4", f"{name}@0", 60, 4) for name in ("blue", "red")])
    newest = record(store, "blue@4", "red@4", 40, 24)  # it is the best-rated too
    opened = Open(store)
    assert [(kind, match.id) for kind, match in highlights(opened, 4)][:2] == [("newest", newest), ("closest", even)]
    assert [match.id for _, match in highlights(opened, 1)] == [newest]
    (first, second) = made = make_clips(opened, 2)
    assert first.caption == (
        f"Newest. Match {newest}: blue@16 against red@8, win blue, 2.0 s. In 3D: `league watch {newest}`."
    )
    assert second.caption.startswith(f"Closest. Match {even}:")
    assert all(clip.path.parent.name == "clips" and clip.path.is_file() for clip in made)


def test_the_shown_part_of_a_long_match_is_told_and_a_damaged_one_left_out(store, monkeypatch):
    monkeypatch.setattr(films, "SECONDS", 1.0)
    record(store, "blue@1", "red@1", 33, 31)
    finish(store, matches=[match("blue@4", "red@4", 60, 4, recording=store.blobs.put(b"no recording"))])
    (clip,) = make_clips(Open(store), 4)
    assert ", 2.0 s, the last 1 s of it." in clip.caption


def test_without_recordings_or_ffmpeg_the_reason_is_told(store, monkeypatch):
    with pytest.raises(StorageError, match="no recorded match yet"):
        make_clips(Open(store), 3)
    clips = BackgroundClips(lambda: Open(store), 3)
    with clips.running():
        assert "no recorded match yet" in clips.note
    record(store, "blue@4", "red@4", 60, 4)
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(ViewerError, match="robot-league"):
        make_clips(Open(store), 3)
    clips = BackgroundClips(lambda: Open(store), 3)
    with clips.running():
        until(lambda: clips.note.startswith("No films: "))
    assert "pip install 'robot-league[video]'" in clips.note


@pytest.mark.slow
def test_in_the_background_they_follow_the_league(store, monkeypatch):
    monkeypatch.setattr("league.matches.match_clips.REST_SECONDS", 0.05)
    first = record(store, "blue@1", "red@1", 48, 16)
    clips = BackgroundClips(lambda: Open(store), 1)
    before = clips.version
    with clips.running():
        until(lambda: clips.shown)
        assert f"Match {first}" in clips.shown[0].caption
        assert clips.version != before
        assert clips.path(clips.shown[0].path.name) == clips.shown[0].path
        assert clips.path("other.webm") is None
        second = record(store, "blue@4", "red@4", 48, 16)
        until(lambda: f"Match {second}" in clips.shown[0].caption)


def test_one_that_is_being_made_is_left_without_a_trace_when_the_server_ends(store, tmp_path, monkeypatch):
    record(store, "blue@1", "red@1", 48, 16)
    clips = BackgroundClips(lambda: Open(store), 1)
    drawn = []
    real = clips._go_on
    monkeypatch.setattr(clips, "_go_on", lambda *at: (drawn.append(at), real(*at)))
    with clips.running():
        until(lambda: drawn)
    assert not clips.shown
    assert list((tmp_path / "cache" / "robot-league" / "clips").iterdir()) == []
