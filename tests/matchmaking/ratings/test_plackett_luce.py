"""Plackett and Luce's model with ties, against published figures, Davidson's model and hand computations."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from matchmaking.ratings.fit import ELO, fit
from matchmaking.ratings.likelihoods import covariance, information, penalised, priors
from matchmaking.ratings.likelihoods.penalised import maximise
from matchmaking.ratings.likelihoods.undefeated import Unbounded
from matchmaking.ratings.payoff import rankings_payoff, sum_matches
from matchmaking.ratings.plackett_luce import PlackettLuce, ranking_chances
from matchmaking.ratings.rankings import Rankings
from storage.records import ArenaKey, RankedMatch, competition_ranks

TAG = ArenaKey("tag", "c0ffee", "c")


def events(*games: dict[int, float]) -> Rankings:
    """Return rankings of games, each a place by player."""
    rows = [(number, player, place) for number, game in enumerate(games) for player, place in game.items()]
    event, player, place = (np.array(column) for column in zip(*rows, strict=True))
    return Rankings.of_events(event, player, place.astype(float))


def random_games(rng: np.random.Generator, number: int, players: int, most: int = 7) -> list[dict[int, float]]:
    """Draw games of two to `most` players whose places often tie."""
    found = []
    for _ in range(number):
        who = rng.choice(players, rng.integers(2, most + 1), replace=False)
        found.append({int(p): float(rng.integers(1, 5)) for p in who})
    return found


def ranked(snapshots: str, rankings: dict[tuple[int, ...], int], voids=0, by_team=None, created=0.0) -> RankedMatch:
    by_team = by_team or (0,) * len(snapshots)
    return RankedMatch("cup", TAG, tuple(snapshots), rankings, voids, by_team, seed=0, created=created)


def test_nascar_2002_has_the_values_of_hunter_2004():
    """83 drivers in 36 races, without the four who were last in every race: Hunter 2004, Annals of Statistics 32, Table
    2, as logarithms and to two digits in the manual of the R package PlackettLuce. Driver 1 is A. Cameron, at 0.
    """
    lines = (Path(__file__).parent / "nascar2002.txt").read_text("utf-8").splitlines()
    races = [{int(driver) - 1: place for place, driver in enumerate(line.split())} for line in lines]
    assert len(races) == 36
    x = maximise(PlackettLuce(events(*races), 83, priors.none()))
    known = {
        58: 4.15,
        68: 3.62,
        51: 2.08,
        15: 0.03,
        17: -0.31,
        40: -0.15,
    }  # Jones, Pruett, Martin, Marcis, Trickle, Varde
    assert {driver: round(x[driver - 1] - x[0], 2) for driver in known} == known


def test_ties_of_two_and_three_have_the_published_values():
    """Six rankings of four fruits, with the coefficients that the manual of PlackettLuce (R) gives for them."""
    games = [
        {0: 1, 1: 2}, {0: 4, 1: 1, 2: 2, 3: 3}, {0: 2, 1: 1, 2: 1, 3: 1}, {0: 1, 1: 2, 2: 3}, {0: 2, 1: 1, 2: 1},
        {0: 1, 2: 3, 3: 2},
    ]  # fmt: skip
    problem = PlackettLuce(events(*games), 4, priors.none())
    x = maximise(problem)
    assert x[1:4] - x[0] == pytest.approx([0.2942875, -0.7335113, -0.1190960], abs=1e-6)
    ties = {k: math.log(delta) for k, delta in problem.ties(x).items()}
    assert ties == pytest.approx({2: -1.8619467, 3: -0.7369735}, abs=1e-6)


def test_rankings_that_occur_as_often_as_expected_give_the_strengths_back():
    # Strengths 1 : 2 : 3. P(3, 2, 1) = 3/6 · 2/3 = 20/60, P(2, 1, 3) = 2/6 · 1/4 = 5/60, ...
    chances = {(0, 1, 2): 4, (0, 2, 1): 6, (1, 0, 2): 5, (1, 2, 0): 15, (2, 0, 1): 10, (2, 1, 0): 20}
    rankings = {tuple(order.index(i) + 1 for i in range(3)): number for order, number in chances.items()}
    ratings = fit(sum_matches([ranked("abc", rankings)]), prior=0)
    assert ratings.elo - ratings.elo[0] == pytest.approx(ELO * np.log([1, 2, 3]), abs=1e-6)
    assert ratings.games.tolist() == [60, 60, 60]
    assert ratings.ties == {}


def test_two_teams_are_rated_exactly_as_by_davidsons_model(match):
    rng, log, games = np.random.default_rng(3), [], []
    for i in range(5):
        for j in range(i):
            counts = rng.integers(1, 9, 3).tolist()
            log.append(match("abcde"[i], "abcde"[j], home=tuple(counts)))
            for number, places in zip(counts, ((1, 2), (1, 1), (2, 1)), strict=True):
                games += [{i: places[0], j: places[1]}] * number
    payoff = sum_matches(log)
    for prior in (0, 1.0, priors.average(4.0), priors.parents(payoff, {"b": "a", "c": "b"})):
        one = fit(payoff, prior=prior, sides=False, anchors=["b"])
        other = fit(replace(payoff, rankings=events(*games)), prior=prior, anchors=["b"])
        for values in ("elo", "stderr", "covariance", "draw", "log_likelihood", "games", "score"):
            assert np.asarray(getattr(one, values)) == pytest.approx(np.asarray(getattr(other, values)), abs=1e-9), (
                values
            )
        assert math.isnan(other.side_stderr)
        assert other.side_advantage == 0


def test_derivatives_are_those_of_the_value():
    rng = np.random.default_rng(0)
    rankings = events(*random_games(rng, 60, 9))
    problem = PlackettLuce(rankings, 9, priors.average(1.0))
    assert {2, 3, 4} <= set(problem.orders)
    x = rng.normal(0, 0.7, len(problem.free)) * problem.free
    gradient, H = problem.gradient(x, problem.terms(x)), problem.information(x, problem.terms(x))
    step = 1e-5 * np.eye(len(x))[problem.free]
    ahead, behind = [x + each for each in step], [x - each for each in step]
    slope = [(problem.evaluate(a)[0] - problem.evaluate(b)[0]) / 2e-5 for a, b in zip(ahead, behind, strict=True)]
    assert gradient[problem.free] == pytest.approx(slope, abs=1e-6)
    curvature = [
        (problem.gradient(b, problem.terms(b)) - problem.gradient(a, problem.terms(a))) / 2e-5
        for a, b in zip(ahead, behind, strict=True)
    ]
    assert H[problem.free] == pytest.approx(np.array(curvature), abs=1e-7)
    sparse = problem.sparse_information(x, problem.terms(x), located=False).times(np.eye(len(x)))
    assert sparse[problem.free] == pytest.approx(H[problem.free], abs=1e-9)


def test_chances_of_rankings_agree_with_the_likelihood():
    strength, ties = [0.3, -0.5, 1.0, 0.0], {2: 0.5, 4: 0.7}
    chances = ranking_chances(strength, ties)
    assert sum(chances.values()) == pytest.approx(1)
    assert len(chances) == 24 + 36 + 6 + 1  # no tie; one pair (6 pairs, 6 orders); two pairs; all four
    assert all(competition_ranks(ranks) == ranks for ranks in chances)
    for ranks, chance in chances.items():
        problem = PlackettLuce(events(dict(enumerate(ranks)), {0: 1, 1: 1}, {0: 1, 1: 1, 2: 1, 3: 1}), 4, priors.none())
        x = np.array([*strength, 0.0, math.log(0.5), math.log(0.7)])
        value = problem.of_games(problem.terms(x))
        pair = math.exp(-0.1) * 0.5
        both = pair / (math.exp(0.3) + math.exp(-0.5) + pair)
        assert value == pytest.approx(math.log(chance) + math.log(both) + math.log(chances[1, 1, 1, 1]))


def test_without_a_prior_those_without_a_finite_rating_are_named():
    with pytest.raises(Unbounded, match="'c' is winless"):
        fit(sum_matches([ranked("abc", {(1, 2, 3): 3, (2, 1, 3): 2})]), prior=0)
    with pytest.raises(Unbounded, match="every game was drawn"):
        fit(sum_matches([ranked("abc", {(1, 1, 1): 3})]), prior=0)


def test_the_order_and_the_rows_of_a_log_do_not_matter():
    log = [
        ranked("abc", {(1, 2, 2): 5, (1, 2, 3): 7, (3, 1, 2): 2, (1, 1, 1): 2}, 2, (1, 0, 0), 5.0),
        ranked("cda", {(1, 2, 2): 5, (3, 1, 2): 7, (1, 1, 3): 2}, 4, (1, 0, 2), 6.0),
        ranked("bac", {(2, 1, 3): 4}, created=7.0),
    ]
    whole = sum_matches(log, ["z"])
    parts = sum_matches(log[2:], ["z"], onto=sum_matches(log[:2]))
    turned = sum_matches([*log[::-1]], ["z"])
    for other in (parts, turned):
        for values in ("home", "away", "voids", "at_fault", "third_voids", "last"):
            assert np.array_equal(getattr(whole, values), getattr(other, values)), values
        assert np.array_equal(fit(whole).elo, fit(other).elo)
    assert whole.names == ("a", "b", "c", "d", "z")
    assert whole.ranked_or_played.tolist() == [34, 20, 34, 14, 0]


def test_every_pair_of_a_lineup_counts_as_one_game():
    payoff = sum_matches([ranked("abc", {(1, 2, 2): 5, (3, 1, 2): 2}, 4, (1, 0, 2))])
    assert payoff.between(np.array(0), np.array([1, 2]))[:, :3].tolist() == [[5, 0, 2], [5, 0, 2]]
    assert payoff.between(np.array(1), np.array(2))[:3].tolist() == [2, 5, 0]
    assert payoff.results.tolist() == [[10, 0, 4], [4, 5, 5], [2, 5, 7]]
    # One void is unclear, one was a's and two were c's: of a and b, those of c are no void.
    assert payoff.voids.tolist() == [2, 4, 3]
    assert payoff.at_fault.tolist() == [[1, 0], [1, 2], [0, 2]]
    assert payoff.episodes_between(np.array([0, 1, 0, 0]), np.array([1, 2, 2, 0])).tolist() == [11, 11, 11, 0]
    assert payoff.episodes_between(np.array(0), np.array(1)) == 11


def test_ties_in_large_fields_are_fitted():
    """Among 40 equals with δ_5 = 1 ties of five would be 16,000 times as likely as a single best."""
    rng, games = np.random.default_rng(4), []
    for _ in range(60):
        who = rng.choice(50, 40, replace=False)
        places = np.cumsum(rng.random(40) > 0.3)
        games.append({int(player): float(place) for player, place in zip(who, places, strict=True)})
    problem = PlackettLuce(events(*games), 50, priors.average(4.0))
    assert max(problem.orders) >= 5
    x = maximise(problem)
    assert np.abs(problem.gradient(x, problem.terms(x))).max() < 1e-6
    assert all(0 < delta < 0.1 for delta in problem.ties(x).values())


def test_a_snapshot_that_plays_several_teams_is_rated():
    ratings = fit(sum_matches([ranked("aab", {(1, 2, 3): 4, (3, 2, 1): 2, (2, 3, 1): 2})]), prior=0)
    # Alone b wins 4 of 8 first choices against two of strength a: π_b / (2 π_a + π_b) = ½. Whoever follows tells too.
    second = PlackettLuce(sum_matches([ranked("aab", {(1, 2, 3): 4, (3, 2, 1): 4})]).rankings, 2, priors.none())
    x = maximise(second)
    assert ratings.elo[1] - ratings.elo[0] == pytest.approx(ELO * (x[1] - x[0]))
    # By hand: first choices say 4 log(p) + 4 log(1 - p), p = s / (2 + s); second ones 4 log(1 / (1 + s)).
    s = np.linspace(0.01, 5, 500_000)
    value = 4 * np.log(s / (2 + s)) + 4 * np.log(1 / (2 + s)) + 4 * np.log(1 / (1 + s))
    assert math.exp(x[1] - x[0]) == pytest.approx(s[value.argmax()], abs=1e-4)


def test_many_players_are_rated_alike_in_a_table_and_by_pairs(monkeypatch):
    rng = np.random.default_rng(1)
    names = tuple(f"{i:02d}" for i in range(40))
    payoff = rankings_payoff(names, events(*random_games(rng, 400, 40, 5)))
    dense = fit(payoff, prior=priors.average(2.0))
    wide = (dense.elo.copy(), dense.stderr.copy(), dense.covariances_with_gaps([7], [9]).copy())
    for module, name in ((penalised, "MAX_DENSE_FIT"), (information, "MAX_DENSE"), (covariance, "MAX_DENSE")):
        monkeypatch.setattr(module, name, 4)
    monkeypatch.setattr(PlackettLuce, "is_dense", False)
    sparse = fit(payoff, prior=priors.average(2.0))
    assert sparse.elo == pytest.approx(wide[0], abs=1e-4)
    assert sparse.covariances_with_gaps([7], [9]) == pytest.approx(wide[2], rel=1e-4, abs=1e-3)
    assert sparse.stderr == pytest.approx(wide[1], rel=0.15)


def test_intervals_of_four_teams_cover_the_truth_at_the_nominal_rate():
    """A small part of experiments/rankings.py, which has the figures of more leagues."""
    rng, inside, ties = np.random.default_rng(2), [], []
    theta = np.array([-1.0, -0.3, 0.2, 1.1])
    chances = ranking_chances(theta.tolist(), {2: 0.4, 3: 0.3})
    for _ in range(150):
        counts = rng.multinomial(120, list(chances.values())).tolist()
        ratings = fit(sum_matches([ranked("abcd", dict(zip(chances, counts, strict=True)))]))
        truth = 1000 + ELO * theta
        inside.append((ratings.low < truth) & (truth < ratings.high))
        ties.append([ratings.ties[2], ratings.ties[3]])
    assert 0.92 < np.mean(inside) < 0.98
    assert np.mean(ties, 0) == pytest.approx([0.4, 0.3], abs=0.03)
