"""An episode shows itself in a notebook as a film, in its players' colours; where none can be made, in words."""

import base64

import pytest

import league
from league.queries.match_players import players_of
from storage.recordings.recording import to_bytes
from tests.dashboards.cars import cars
from tests.league.leagues import filled, finish, match
from tests.markup import Markup


@pytest.fixture
def opened(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOT_LEAGUE_CACHE", str(tmp_path / "cache"))
    with filled(tmp_path / "league-data") as store:
        finish(store, matches=[match("blue@4", "red@4", 60, 4, recording=store.blobs.put(to_bytes(cars())))])
    with league.open(str(tmp_path / "league-data")) as opened:
        yield opened


def test_a_notebook_shows_the_film_that_the_file_holds(opened):
    episode = opened.recording()
    (found,) = opened.store.matches("cup")
    assert episode.players == players_of(opened, found, episode.header.sides)
    shown = Markup(episode._repr_html_())
    assert shown.links == [f"data:video/webm;base64,{base64.b64encode(episode.film().read_bytes()).decode()}"]
    assert shown.captions == {"match-1": "episode of match 1: blue@16 against red@8, 100 steps, win blue"}
    assert opened.episodes(1)[0].film() == episode.film()


def test_without_ffmpeg_a_notebook_says_so(opened, monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    shown = Markup(opened.recording()._repr_html_())
    assert not shown.links
    assert "pip install 'robot-league[video]'" in shown.captions["match-1"]
