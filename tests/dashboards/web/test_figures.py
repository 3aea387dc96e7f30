"""Figures as values: Plotly takes every one of them, and they hold what they were given."""

import colorsys

import numpy as np
import plotly.graph_objects as go
import pytest

from dashboards.identity import COLOURS
from dashboards.web import figures

LADDER = [
    {"name": "blue@4", "player": "blue", "elo": 1200.0, "low": 1150.0, "high": 1260.0, "steps": 400},
    {"name": "pusher", "player": None, "elo": 1100.0, "low": 1000.0, "high": 1200.0, "steps": None},
    {"name": "blue@0", "player": "blue", "elo": 1000.0, "low": 990.0, "high": 1010.0, "steps": 0},
    {"name": "red@0", "player": "red", "elo": None, "low": None, "high": None, "steps": 0},
]


def checked(figure: figures.Figure) -> dict[str, dict]:
    """Its traces by name, after Plotly's own check of every property."""
    assert len(go.Figure(figure).data) == len(figure["data"])
    return {trace.get("name", trace["type"]): trace for trace in figure["data"]}


def test_a_ladder_has_each_rating_with_its_interval_and_the_best_on_top():
    figure = figures.ladder(LADDER)
    traces = checked(figure)
    assert traces["blue"]["x"] == [1200.0, 1000.0]
    assert traces["blue"]["error_x"]["array"] == [60.0, 10.0]
    assert traces["blue"]["error_x"]["arrayminus"] == [50.0, 10.0]
    assert traces["fixed"]["y"] == ["pusher"]
    assert figure["layout"]["yaxis"]["categoryarray"] == ["blue@0", "pusher", "blue@4"]
    assert "red" not in traces


def test_more_players_than_colours_have_other_markers():
    rows = [{**LADDER[0], "name": f"p{i}@4", "player": f"p{i}"} for i in range(12)]
    markers = [trace["marker"] for trace in checked(figures.ladder([*rows, LADDER[1]])).values()]
    assert len({(marker["color"], marker["symbol"]) for marker in markers}) == 13


def test_players_have_the_colours_of_their_films_in_every_figure():
    teams = ("blue", "red", "green", "yellow")
    rows = [{**LADDER[0], "name": f"{team}@4", "player": team, "parent": None} for team in teams]
    drawn = [
        checked(figures.ladder(rows, "elo", teams)),
        checked(figures.ladder([*rows[2:], rows[0]], "elo", teams)),
        checked(figures.lineage(rows, teams)),
        checked(figures.curves({team: ((1, 2), (0, 1)) for team in teams}, "reward", players=teams)),
    ]
    found = {
        (name, (trace.get("marker") or trace["line"])["color"]) for traces in drawn for name, trace in traces.items()
    }
    assert len(found) == 4
    filmed = [hue(colour) for colour in COLOURS[:4]]
    for name, colour in found:
        apart = [abs(hue([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) - other) for other in filmed]
        assert teams[int(np.argmin(apart))] == name


def hue(colour) -> float:
    """The hue, 0 to 1, of red, green and blue."""
    return colorsys.rgb_to_hsv(*(part / 255 for part in colour))[0]


def test_where_there_is_one_team_success_is_shown():
    row = {"name": "blue@4", "player": "blue", "success": 0.5, "success_low": 0.4, "success_high": 0.7, "steps": 4}
    trace = checked(figures.ladder([row], "success"))["blue"]
    assert trace["error_x"]["array"] == pytest.approx([0.2])
    assert checked(figures.ratings([row], "success"))["blue"]["y"] == [0.5]


def test_ratings_run_over_steps_with_a_band_around_them():
    figure = figures.ratings(LADDER)
    traces = checked(figure)
    assert (traces["blue"]["x"], traces["blue"]["y"]) == ([0, 400], [1000.0, 1200.0])
    band = figure["data"][0]
    assert (band["x"], band["y"]) == ([0, 400, 400, 0], [1010.0, 1260.0, 1150.0, 990.0])
    assert (traces["pusher"]["x"], traces["pusher"]["y"]) == ([0, 400], [1100.0, 1100.0])


def test_pairs_that_have_not_met_are_blank_in_the_heat_map():
    scores, games = np.array([[0.5, np.nan], [0.25, 0.5]]), np.array([[0, 0], [64, 0]])
    heat = checked(figures.payoff(["a", "b"], ["a", "b"], scores, games))["heatmap"]
    assert heat["z"] == [[0.5, None], [0.25, 0.5]]
    assert heat["customdata"][1][0] == 64


def test_opponents_that_are_never_met_are_left_out_and_many_are_summed_up():
    rows = [{"opponent": f"red@{i}", "probability": p, "present": False} for i, p in enumerate([0.0, 0.25, 0.25])]
    rows.append({"opponent": "red", "probability": 0.5, "present": True})
    bars = checked(figures.mixture(rows))["bar"]
    assert bars["y"] == ["red (as it is now)", "red@1", "red@2"]
    assert bars["x"] == [0.5, 0.25, 0.25]
    many = [{"opponent": f"red@{i}", "probability": 0.001, "present": False} for i in range(1000)]
    bars = checked(figures.mixture(many))["bar"]
    assert bars["y"][-1] == "960 others"
    assert sum(bars["x"]) == pytest.approx(1.0)


def test_curves_have_a_line_for_each_player_where_it_was_recorded():
    traces = checked(figures.curves({"blue": ([10, 20], [0.5, 0.75]), "red": ([], [])}, "score"))
    assert (traces["blue"]["x"], traces["blue"]["y"]) == ([10, 20], [0.5, 0.75])
    assert "red" not in traces


def test_long_lines_are_thinned_to_means_and_keep_their_end():
    x, y = figures.thinned([float(i) for i in range(1000)], [float(i % 2) for i in range(1000)], 100)
    assert len(x) == 100
    assert x[-1] == 999.0
    assert y == [0.5] * 100
    assert figures.thinned([1.0], [2.0]) == ([1.0], [2.0])
    assert figures.thinned([], []) == ([], [])


def test_lineage_draws_a_line_from_each_snapshot_to_the_one_that_it_goes_on_from():
    rows = [
        {"name": "pusher", "player": None, "parent": None, "steps": 0},
        {"name": "blue@0", "player": "blue", "parent": None, "steps": 0},
        {"name": "blue@4", "player": "blue", "parent": "blue@0", "steps": 400},
        {"name": "red@4", "player": "red", "parent": "gone@1", "steps": 400},
    ]
    traces = checked(figures.lineage(rows))
    assert (traces["scatter"]["x"], traces["scatter"]["y"]) == ([0, 400, None], ["blue", "blue", None])
    assert traces["blue"]["customdata"] == ["nobody", "blue@0"]
    assert traces["fixed"]["text"] == ["pusher"]
