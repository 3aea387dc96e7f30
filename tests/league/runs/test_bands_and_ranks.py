"""Curves with bands and ranks of cells, on figures that can be worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from dashboards.web.document import document
from league.config.experiment import default
from league.config.schema import ConfigError
from league.config.sections import PlayerSettings
from league.queries.query import Open
from league.runs.comparison.cell_ranks import ranked, verdict
from league.runs.comparison.cells import Cell, Member
from league.runs.comparison.comparison_report import Comparison, page, text
from league.runs.comparison.cross_play import CrossPlay
from league.runs.comparison.curve_bands import _band, _curve, apart, bands
from league.runtime.bootstrap import create
from storage.records import CurvePoint
from storage.store import Store
from tests.league.leagues import filled, finish, match, player, snapshot


def cell(text: str, *names: str) -> Cell:
    return Cell(text, {"lr": text}, [Member(None, name, {}) for name in names])  # type: ignore[arg-type]


def row(league: str, elo: float, half: float = 10.0, known: bool = True, role: str = "main") -> dict:
    own = {"league": league, "name": f"{league}-{elo}", "role": role, "known": known}
    return {**own, "elo": elo, "low": elo - half, "high": elo + half}


def test_a_band_is_the_mean_and_range_of_leagues_up_to_the_last_common_step():
    one = np.array([10.0, 20.0, 40.0]), np.array([0.0, 1.0, 1.0])
    two = np.array([10.0, 30.0]), np.array([0.5, 0.5])
    band = _band("lr", {"lr.s1": one, "lr.s2": two})
    assert band is not None
    assert band.steps.tolist() == [10, 20, 30]
    assert band.mean.tolist() == [0.25, 0.75, 0.75]
    assert band.low.tolist() == [0.0, 0.5, 0.5]
    assert band.high.tolist() == [0.5, 1.0, 1.0]
    assert band.at(15) == (0.5, 0.25, 0.75)
    assert (band.at(9), band.at(31)) == (None, None)
    assert (band.leagues, band.left_out) == (2, ())
    assert _band("none", {"none.s1": (np.zeros(0), np.zeros(0))}) is None


def test_a_league_counts_in_no_band_where_it_has_no_curve_and_is_named():
    early = np.array([100.0, 400.0]), np.array([0.5, 0.6])
    late = np.array([500.0, 900.0]), np.array([0.75, 0.9])
    band = _band("lr", {"early": early, "late": late})
    assert band is not None
    assert (band.steps.tolist(), band.mean.tolist(), band.leagues) == ([100, 400], [0.5, 0.6], 1)
    assert apart([band], "score").endswith("known at none of their cell's steps: late (cell lr).")
    band = _band("lr", {"early": early, "late": late, "later": (np.array([600.0, 700.0]), np.array([0.0, 1.0]))})
    assert band is not None  # the most leagues with a step in common
    assert (band.steps.tolist(), band.low.tolist(), band.leagues) == ([600, 700], [0, 0.825], 2)
    assert band.left_out == ("early",)
    assert apart([replace(band, left_out=())], "score") == ""


def test_a_cell_has_no_value_at_steps_where_it_has_no_band():
    early = _band("early", {"early.s1": (np.array([100.0, 400.0]), np.array([0.5, 0.6]))})
    late = _band("late", {"late.s1": (np.array([500.0, 900.0]), np.array([0.75, 0.9]))})
    assert early is not None
    assert late is not None
    shown = text(Comparison([], "score", [early, late], [], [], "elo", []))[0].splitlines()
    assert [line.split() for line in shown if "early" in line or "late" in line] == [
        ["early", "1", "0.6", "–"], ["late", "1", "–", "0.9"],
    ]  # fmt: skip
    lone = _band("late", {"early": (np.array([100.0]), np.array([0.5])), "late": (np.array([500.0]), np.array([1.0]))})
    assert lone is not None
    told = Comparison([], "score", [lone], [], [], "elo", [])
    assert "late (cell late)" in " ".join(text(told)[1].split())
    assert "late (cell late)" in document(page(told, "Comparison", "here"))


def test_a_league_whose_players_have_no_step_in_common_has_no_curve(tmp_path):
    recorded = {"blue": (100, 200), "red": (300, 400)}
    points = [
        CurvePoint("cup", name, i, step, float(i), {"score": 0.5})
        for name, steps in recorded.items()
        for i, step in enumerate(steps, 1)
    ]
    with filled(tmp_path) as store:
        finish(store, curves=points)
        member = Member(Open(store, "cup"), "cup", {})
        assert _curve(member, "score")[0].size == 0
        assert bands([Cell("lr", {}, [member])], "score") == []
        with pytest.raises(ConfigError, match="metric 'scores' was not recorded; there are: "):
            bands([Cell("lr", {}, [member])], "scores")


def test_a_league_has_the_mean_of_its_players_between_whose_points_it_is_interpolated(tmp_path):
    recorded = {"blue": {100: 0.9, 200: 0.7, 400: 0.9}, "red": {150: 0.1, 250: 0.3}}
    points = [
        CurvePoint("cup", name, i, step, float(i), {"score": value})
        for name, values in recorded.items()
        for i, (step, value) in enumerate(values.items(), 1)
    ]
    with filled(tmp_path, match("blue@1", "blue@0", 60, 40), match("red@4", "red@0", 80, 20)) as store:
        finish(store, curves=points, matches=[match("blue@4", "blue@0", 90, 10)])
        member = Member(Open(store, "cup"), "cup", {})
        steps, values = _curve(member, "score")
        assert steps.tolist() == [150, 200, 250]
        assert values.tolist() == pytest.approx([(0.8 + 0.1) / 2, (0.7 + 0.2) / 2, (0.75 + 0.3) / 2])
        steps, values = _curve(member, "vs_initial")
        assert (steps.tolist(), values.tolist()) == ([400], [pytest.approx((0.9 + 0.8) / 2)])


def test_a_cell_has_the_interval_of_its_leagues_and_a_single_league_that_of_its_ratings():
    rows = [row("a1", 1010), row("a1", 1030), row("a2", 1040), row("b1", 900), row("b2", 1500, known=False)]
    first, second = ranked([cell("b", "b1", "b2"), cell("a", "a1", "a2")], rows, "elo")
    assert (first.cell.text, first.leagues, first.mean, first.worst, first.best) == ("a", 2, 1030, 1020, 1040)
    error = 12.7062 * math.sqrt(200) / math.sqrt(2)  # Student's quantile of one degree of freedom
    assert first.high - first.mean == pytest.approx(error, rel=1e-4)
    assert (second.leagues, second.low, second.high) == (1, pytest.approx(890), pytest.approx(910))


def test_exploiters_do_not_count_for_a_cell_unless_its_league_has_no_other_player():
    rows = [row("a", 1100), row("a", 700, role="main_exploiter"), row("b", 900, role="league_exploiter")]
    rows += [row("c", 1300, known=False), row("c", 1200, role="main_exploiter")]
    ranks = ranked([cell(name, name) for name in "abc"], rows, "elo")
    assert [(rank.cell.text, rank.mean) for rank in ranks] == [("a", 1100), ("b", 900)]


def test_players_keep_their_roles_on_the_ladder_of_cross_play(tmp_path):
    roles = {"blue": "main", "red": "main", "hunter": "main_exploiter"}
    teams = [("blue", "blue"), ("red", "red"), ("red", "hunter")]
    settings = tuple(PlayerSettings(team, name, roles[name]) for team, name in teams)
    config = replace(default("rock-paper-scissors"), league="cup", players=settings)
    with Store.open(tmp_path, create=True) as store:
        create(store, config, config.arena.build())
        blob = store.blobs.put(b"policy")
        store.add_snapshots([snapshot(each, 1, blob) for each in store.players("cup")])
        crossed = CrossPlay([Member(Open(store, "cup"), "cup", {})], store)
        rows = crossed.rows(crossed.ladder())
        assert {row["player"]: row["role"] for row in rows} == {f"cup.{name}": role for name, role in roles.items()}


def test_a_curve_is_that_of_players_that_learn_and_are_no_exploiters(tmp_path):
    with filled(tmp_path, match("blue@4", "blue@0", 90, 10), match("red@4", "red@0", 80, 20)) as store:
        others = [replace(player("hunter", 1), role="main_exploiter"), player("at-rest", 1)]
        store.add_players(others)
        blob = store.blobs.put(b"policy")
        store.add_snapshots([snapshot(others[0], 1, blob), *(snapshot(each, 0, blob) for each in others)])
        finish(store, matches=[match("hunter@1", "hunter@0", 50, 50), match("at-rest@0", "red@0", 50, 50)])
        steps, values = _curve(Member(Open(store, "cup"), "cup", {}), "vs_initial")
        assert (steps[-1], values[-1]) == (400, pytest.approx(0.85))
        assert _curve(Member(Open(store, "cup"), "cup", {}), "elo")[0][-1] == 400


def test_the_best_cell_is_named_as_sure_only_where_it_is():
    close = [row(f"a{i}", 1000 + i) for i in range(3)] + [row(f"b{i}", 1001 + i) for i in range(3)]
    far = [row(f"a{i}", 1000 + i) for i in range(3)] + [row(f"b{i}", 1300 + i) for i in range(3)]
    both = [cell("a", "a0", "a1", "a2"), cell("b", "b0", "b1", "b2")]
    assert verdict(ranked(both, close, "elo"), 0).startswith("Highest: b; it is not known whether")
    assert verdict(ranked(both, far, "elo"), 0).startswith("Best: b, better than the next, a, by 300 (298 to 302)")
    assert verdict(ranked(both[:1], far, "elo"), 0) == ""
