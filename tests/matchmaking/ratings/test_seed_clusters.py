"""Rankings of games that share a seed: their dispersion, against Davidson's model and against copies of one game."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from matchmaking.ratings.fit import ELO, Ratings, fit
from matchmaking.ratings.payoff import sum_matches
from matchmaking.ratings.plackett_luce import ranking_chances
from matchmaking.ratings.rankings import Rankings
from storage.records import ArenaKey, LineupTotals, PairCounts, RankedMatch, SeedCluster

TAG = ArenaKey("tag", "c0ffee", "c")
THETA = (0.5, -0.4, 0.1)
TIES = {2: 0.4, 3: 0.2}


def rotations(snapshots: str, seeds: list[SeedCluster]) -> list[RankedMatch]:
    """Return the rows of a lineup's rotations, with the seed clusters in the first one."""
    found, n = [], len(snapshots)
    for i in range(n):
        order = [(i + j) % n for j in range(n)]
        rankings = Counter(tuple(seed[i][j] for j in order) for seed in seeds)
        names = tuple(snapshots[j] for j in order)
        found.append(RankedMatch("cup", TAG, names, rankings, 0, (0,) * n, seed=1))
    return [replace(found[0], seed_clusters=dict(Counter(seeds))), *found[1:]]


def drawn(rng: np.random.Generator, seeds: int, copies: bool = False) -> list[SeedCluster]:
    """Draw the rankings of three rotations by the model's chances; `copies` of one ranking, or three of their own."""
    chances = ranking_chances(THETA, TIES)
    ranks, number = list(chances), (seeds, 1 if copies else 3)
    which = rng.choice(len(ranks), number, p=list(chances.values()))
    return [tuple(ranks[i] for i in np.broadcast_to(row, 3)) for row in which]


def ignoring_seeds(log: list[RankedMatch], prior: float = 1.0) -> Ratings:
    return fit(sum_matches([replace(match, seed_clusters={}) for match in log]), prior=prior)


def test_two_teams_have_the_intervals_of_seed_pairs(match):
    rng, log, lineups = np.random.default_rng(3), [], {}
    kinds = {"ll": "LL", "ld": "LD", "dd_wl": "WL", "dw": "DW", "ww": "WW"}
    ranks = {"W": (1, 2), "D": (1, 1), "L": (2, 1)}
    for i, j in ((1, 0), (2, 0), (2, 1)):
        counts = dict(zip(kinds, rng.integers(1, 30, 5).tolist(), strict=True))
        home = [sum(n for kind, n in counts.items() if kinds[kind][0] == result) for result in "WDL"]
        away = [sum(n for kind, n in counts.items() if kinds[kind][1] == result) for result in "WDL"]
        a, b = "abc"[i], "abc"[j]
        log.append(match(a, b, home=tuple(home), away=tuple(away), pairs=PairCounts(**counts)))
        clusters = {(ranks[kinds[kind][0]], ranks[kinds[kind][1]]): n for kind, n in counts.items()}
        rankings = {ranks[r]: home[k] + away[k] for k, r in enumerate("WDL")}
        lineups[a, b] = LineupTotals(rankings, 0, (0, 0), 0.0, clusters)
    payoff = sum_matches(log)
    place: dict[str | None, int] = {name: i for i, name in enumerate(payoff.names)}
    of_pairs = fit(payoff, sides=False)
    of_rankings = fit(replace(payoff, rankings=Rankings.of(lineups, place)))
    assert of_rankings.elo == pytest.approx(of_pairs.elo)
    assert of_rankings.covariance == pytest.approx(of_pairs.covariance)
    alone = fit(replace(payoff, pairs=np.zeros_like(payoff.pairs)), sides=False)
    assert of_pairs.stderr != pytest.approx(alone.stderr, rel=0.01)


def test_copies_of_one_game_tell_as_much_as_one():
    seeds = drawn(np.random.default_rng(0), 4000, copies=True)
    log = rotations("abc", seeds)
    once = ignoring_seeds(log[:1], prior=0)
    assert fit(sum_matches(log), prior=0).stderr == pytest.approx(once.stderr, rel=0.02)
    assert ignoring_seeds(log, prior=0).stderr == pytest.approx(once.stderr / np.sqrt(3), rel=0.02)


def test_games_that_share_a_seed_and_are_independent_have_the_intervals_of_independent_games():
    log = rotations("abc", drawn(np.random.default_rng(0), 4000))
    assert fit(sum_matches(log)).stderr == pytest.approx(ignoring_seeds(log).stderr, rel=0.02)
    assert fit(sum_matches(log)).elo == pytest.approx(ignoring_seeds(log).elo)


def test_games_outside_clusters_count_as_independent():
    """Half of the games are copies, with three times the variance; so the variance is twice that of all alone."""
    rng = np.random.default_rng(0)
    alone = [replace(m, seed_clusters={}) for m in rotations("abc", drawn(rng, 4000))]
    log = [*rotations("abc", drawn(rng, 4000, copies=True)), *alone]
    assert fit(sum_matches(log)).stderr == pytest.approx(np.sqrt(2) * ignoring_seeds(log).stderr, rel=0.02)


def test_the_order_of_rows_and_seats_does_not_matter():
    rng = np.random.default_rng(5)
    seeds = [drawn(rng, 30, copies=True) for _ in range(3)]
    log = [*rotations("abc", seeds[0]), *rotations("cbd", seeds[1]), *rotations("abc", seeds[2])]
    whole = sum_matches(log)
    turned = [tuple(reversed(seed)) for seed in seeds[2]]
    parts = sum_matches(log[4:], onto=sum_matches(log[:4]))
    reversed_log = sum_matches([*log[:6], *rotations("abc", turned)][::-1])
    for other in (parts, reversed_log):
        for one, two in zip(whole.rankings.clusters, other.rankings.clusters, strict=True):
            assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
        assert np.array_equal(fit(whole).stderr, fit(other).stderr)
    assert sum(int(each.number.sum()) for each in whole.rankings.clusters) == 90


def test_a_snapshot_in_two_seats_counts_once_in_its_cluster():
    """Two seats of one snapshot: its score in a game is the sum over both, of which one is in each alternative."""
    rng = np.random.default_rng(1)
    chances = ranking_chances((0.5, 0.5, -0.2), {})
    ranks = list(chances)
    seeds = [(ranks[i],) * 3 for i in rng.choice(len(ranks), 4000, p=list(chances.values()))]
    log = rotations("aab", seeds)
    once = ignoring_seeds(log[:1], prior=0)
    assert fit(sum_matches(log), prior=0).stderr == pytest.approx(once.stderr, rel=0.02)


@pytest.mark.slow
def test_intervals_of_games_that_share_seeds_hold_the_truth_at_the_nominal_rate():
    """A small part of experiments/rankings.py, which has the figures of more leagues."""
    rng, inside, ignoring = np.random.default_rng(2), [], []
    truth = ELO * (np.array(THETA) - np.mean(THETA)) + 1000
    for _ in range(150):
        log = rotations("abc", drawn(rng, 100, copies=True))
        for found, held in ((fit(sum_matches(log)), inside), (ignoring_seeds(log), ignoring)):
            held.append((found.low < truth) & (truth < found.high))
    assert 0.92 < np.mean(inside) < 0.98
    assert np.mean(ignoring) < 0.85
