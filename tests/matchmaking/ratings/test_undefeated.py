"""Fits without a prior: what they say where a maximum exists, and whom they name where there is none."""

import math
import random

import choix
import numpy as np
import pytest

from matchmaking.ratings.fit import ELO, fit
from matchmaking.ratings.likelihoods.undefeated import Unbounded
from matchmaking.ratings.payoff import sum_matches


def free(log, **options):
    return fit(sum_matches(log), prior=0, anchor_elo=0, **options)


def wins(match, **counts):
    """Games without draws, `ab=3` for three that a won against b, on one side only."""
    return [match(a, b, home=(n, 0, 0)) for (a, b), n in counts.items()]


def test_the_example_of_an_encyclopaedia(match):
    # Wikipedia, "Bradley-Terry model": p is proportional to these.
    ratings = free(wins(match, AB=2, BA=3, AD=1, DA=4, BC=5, CB=3, CD=1, DC=3), sides=False)
    p = np.array([0.640, 1.043, 0.660, 2.270])
    odds = np.exp(ratings.elo / ELO)
    assert odds / odds.sum() * p.sum() == pytest.approx(p, abs=1e-3)
    assert ratings.log_likelihood == pytest.approx(
        sum(n * math.log(p[i] / (p[i] + p[j])) for i, j, n in
            [(0, 1, 2), (1, 0, 3), (0, 3, 1), (3, 0, 4), (1, 2, 5), (2, 1, 3), (2, 3, 1), (3, 2, 3)]), abs=1e-4,
    )  # fmt: skip


def test_davidson_for_two_in_closed_form(match):
    # win : draw : loss = π : ν√(πρ) : ρ is saturated by 40 : 20 : 10, so the odds are 4 and ν = 20/√(40 · 10).
    ratings = free([match("a", "b", home=(40, 20, 10))])
    assert ratings.elo[0] - ratings.elo[1] == pytest.approx(400 * math.log10(4), abs=1e-9)
    assert ratings.draw == pytest.approx(1, abs=1e-12)
    assert ratings.log_likelihood == pytest.approx(sum(n * math.log(n / 70) for n in (40, 20, 10)))
    assert math.isnan(ratings.side_stderr)


def test_the_standard_error_of_two_is_the_textbook_one(match):
    ratings = free([match("a", "b", home=(30, 0, 10), away=(30, 0, 10))], anchors=["b"])
    assert ratings.stderr == pytest.approx([ELO / math.sqrt(80 * 3 / 16), 0])
    # Side and strength: odds at home 8, away 2, so both are factors; their errors are those of half a sum of logits.
    side_identifiable = free([match("a", "b", home=(80, 0, 10), away=(60, 0, 30))], anchors=["b"])
    assert side_identifiable.side_advantage == pytest.approx(400 * math.log10(2))
    error = ELO / 2 * math.sqrt(1 / 80 + 1 / 10 + 1 / 60 + 1 / 30)
    assert (side_identifiable.side_stderr, side_identifiable.stderr[0]) == pytest.approx((error, error))


def test_a_ring_of_games_tells_the_side_from_strength(match):
    # a, b and c are equal, and whoever is at home wins two of three games.
    ratings = free([match(a, b, home=(20, 0, 10)) for a, b in ("ab", "bc", "ca")])
    assert ratings.elo == pytest.approx([0, 0, 0], abs=1e-9)
    assert ratings.side_advantage == pytest.approx(400 * math.log10(2))


def test_rock_paper_scissors_is_level(match):
    ratings = free(wins(match, pr=90, rp=10, rs=90, sr=10, sp=90, ps=10), sides=False)
    assert ratings.elo == pytest.approx([0, 0, 0], abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_choix_says_the_same(match, seed):
    rng = np.random.default_rng(seed)
    theta = rng.normal(0, 1, 8)
    pairs = [(i, j) for i in range(8) for j in range(8) if i != j]
    games = [(i, j) for i, j in pairs for _ in range(12) if rng.random() < 1 / (1 + math.exp(theta[j] - theta[i]))]
    ours = free([match(str(i), str(j), home=(1, 0, 0)) for i, j in games], sides=False)
    theirs = choix.ilsr_pairwise(8, games, alpha=0, max_iter=1000, tol=1e-12)
    assert ours.elo / ELO == pytest.approx(theirs - theirs.mean(), abs=1e-6)


@pytest.mark.slow
def test_intervals_cover_at_the_nominal_rate_without_a_prior(simulate):
    """1,000 leagues of five players, pooled over players; the differences to the anchor are covered."""
    theta, rng = np.array([0.0, -0.8, -0.3, 0.4, 0.9]), np.random.default_rng(0)
    pairs = [(i, j) for i in range(5) for j in range(i)]
    covered = []
    for _ in range(1000):
        log = [simulate(str(i), str(j), theta[i] - theta[j], 10, rng) for i, j in pairs]
        bare = [m.__class__(**{**vars(m), "pairs": type(m.pairs)()}) for m in log]
        ratings = free(bare, anchors=["0"])
        covered.append((ratings.low < ELO * theta) & (ELO * theta < ratings.high))
    assert 0.93 < np.array(covered)[:, 1:].mean() < 0.97


def test_neither_order_nor_batching_matters(match, simulate):
    rng = np.random.default_rng(0)
    theta = np.linspace(-1, 1, 6)
    log = [simulate(str(i), str(j), theta[i] - theta[j], 10, rng) for i in range(6) for j in range(i)]
    halves = []
    for m in log:
        away = (m.wins - m.side_wins, m.draws - m.side_draws, m.losses - m.side_losses)
        halves += [match(m.a, m.b, home=(m.side_wins, m.side_draws, m.side_losses)), match(m.a, m.b, away=away)]
    whole = [match(m.a, m.b, h, a) for m, h, a in (
        (m, (m.side_wins, m.side_draws, m.side_losses),
         (m.wins - m.side_wins, m.draws - m.side_draws, m.losses - m.side_losses)) for m in log
    )]  # fmt: skip
    one, other = free(whole), free(random.Random(0).sample(halves, len(halves)))
    assert other.elo == pytest.approx(one.elo, abs=1e-9)
    assert other.stderr == pytest.approx(one.stderr, abs=1e-9)


@pytest.mark.parametrize(
    ("counts", "says"),
    [
        ({"ab": 3, "bc": 1, "cb": 1}, "'a' is undefeated: it has won every game"),
        ({"ab": 3, "ba": 1, "bc": 1, "ac": 1}, "'c' is winless: it has lost every game"),
        ({"ab": 1, "ba": 1, "cd": 1, "dc": 1}, "'c' is disconnected from 'a'"),
        ({"ab": 1, "ba": 1, "cd": 1, "dc": 1, "ca": 1}, "'c', 'd', taken together, are undefeated by 'a', 'b'"),
        ({"ab": 1, "ba": 1, "cd": 1, "dc": 1, "ac": 1}, "'c', 'd', taken together, are winless against 'a', 'b'"),
    ],
)
def test_who_has_no_finite_rating_is_named(match, counts, says):
    with pytest.raises(Unbounded, match=says):
        free(wins(match, **counts), sides=False)


def test_draws_and_sides_without_end_are_named(match):
    with pytest.raises(Unbounded, match="every game was drawn"):
        free([match("a", "b", home=(0, 9, 0))])
    with pytest.raises(Unbounded, match="one side wins where strengths do not tell"):
        free([match("a", "b", home=(5, 0, 0), away=(0, 0, 5))])
    with pytest.raises(Unbounded, match="'a' is undefeated: it has not lost a game"):
        free([match("a", "b", home=(3, 2, 0))])
    with pytest.raises(Unbounded, match="'c' has not played"):
        fit(sum_matches([match("a", "b", home=(1, 0, 1))], players=["c"]), prior=0)


def test_there_is_a_maximum_exactly_where_a_linear_programme_says_so(match):
    """Albert and Anderson 1984: it exists unless some direction lowers no game's likelihood and raises one's."""
    from scipy.optimize import linprog

    from matchmaking.ratings.davidson import Likelihood
    from matchmaking.ratings.likelihoods import priors

    rng, found = np.random.default_rng(0), []
    for _ in range(300):
        n = rng.integers(2, 5)
        log = [match(*map(str, rng.choice(n, 2, replace=False)), home=rng.integers(0, 2, 3)) for _ in range(7)]
        payoff = sum_matches([m for m in log if m.wins + m.draws + m.losses])
        problem = Likelihood.of(payoff, priors.none())
        P, rows = problem.size, []
        for i, j, counts in zip(problem.home, problem.away, problem.counts, strict=True):
            gap = np.eye(P + 2)[i] - np.eye(P + 2)[j] + problem.free[P] * np.eye(P + 2)[P]
            outcomes = {0: gap / 2, 2: -gap / 2} | ({1: np.eye(P + 2)[P + 1]} if problem.free[P + 1] else {})
            rows += [outcomes[k] - other for k in outcomes if counts[k] for other in outcomes.values()]
        A = np.array(rows)
        gain = -linprog(-A.sum(0), A_ub=-A, b_ub=np.zeros(len(A)), bounds=(-1, 1)).fun
        exists = gain < 1e-7 and np.linalg.matrix_rank(A) == problem.free.sum() - 1
        try:
            ratings = fit(payoff, prior=0)
            assert np.isfinite(ratings.elo).all()
            assert np.isfinite(ratings.stderr).all()
        except Unbounded:
            found.append((exists, False))
        else:
            found.append((exists, True))
    assert set(found) == {(True, True), (False, False)}
