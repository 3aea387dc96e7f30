"""`league demo`: matches of policies that come with the package, without a store."""

import pytest

from arenas.rosters import AgentSizes, roster_text
from league.commands.watch.demo import DEMOS, arena_settings, demo
from league.queries.arena_info import outline
from league.snapshots.policy_file import find, read
from tests.league.packs import refused


@pytest.mark.parametrize("name", DEMOS)
def test_the_policies_of_a_demo_play_the_teams_of_its_arena(name):
    teams = outline(arena_settings(DEMOS[name])).teams
    rosters = [roster_text(AgentSizes(*seat) for seat in seats) for seats in teams.values()]
    assert [read(find(side)).about["roster"] for side in DEMOS[name].sides] == rosters


def test_a_demo_is_played_and_drawn_without_a_store_or_a_display(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert demo(["fly", "--video", "fly.gif", "--seconds", "0.5", "--rate", "4"]) == 0
    assert capsys.readouterr().out.startswith("galaga-fly-1v1: crazyflie-fly succeeds")
    assert [path.name for path in tmp_path.iterdir()] == ["fly.gif"]


def test_bad_requests_are_refused_before_anything_is_played(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert "there is no display here; use --web" in refused(capsys, "demo")
    assert "no demo 'sumou'" in refused(capsys, "demo", "sumou")
    assert "out.txt" in refused(capsys, "demo", "--shot", str(tmp_path / "out.txt"))


def test_all_demos_are_listed(capsys):
    assert demo(["--list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out and each.about in out for name, each in DEMOS.items())
