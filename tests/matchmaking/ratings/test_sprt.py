"""The sequential test against published figures, against a direct maximisation, and by simulation of whole tests."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import minimize

from matchmaking.ratings.scores import PAIR_SCORES
from matchmaking.ratings.sprt import NEVER, NORMALIZED, Model, SequentialTest, elo_from_score, score_from_elo

# Pair counts, bounds and LLR as Fishtest printed them, in pull requests of official-stockfish/Stockfish.
LOGISTIC = [
    ((424, 2948, 5832, 3045, 460), (-1.0, 3.0), 2.94),  # 2493
    ((1284, 17437, 55536, 18085, 1292), (0.0, 2.0), 2.94),  # 2493
    ((58, 3302, 33130, 3518, 84), (0.25, 1.25), 2.97),  # 3209
    ((40, 1272, 12142, 1300, 30), (-1.5, 0.5), 3.01),  # 3017
    ((14, 1030, 14318, 1163, 19), (0.25, 1.25), 2.93),  # 3331
    ((17, 253, 1042, 337, 39), (-0.5, 1.5), 2.96),  # 2971
    ((47, 2568, 23495, 2604, 58), (-0.75, 0.25), 2.94),  # 3103
]
NORMALIZED_ELO = [
    ((117, 4287, 9664, 4481, 135), (-0.5, 2.5), 2.95),  # 3679
    ((11, 1383, 3682, 1571, 17), (0.5, 3.5), 2.94),  # 3679
    ((82, 17255, 47510, 17822, 87), (0.5, 3.0), 2.93),  # 3784
    ((327, 8113, 21317, 8168, 347), (-2.25, 0.25), 2.96),  # 3972
    ((1402, 55789, 136915, 55460, 1426), (-1.75, 0.25), 2.96),  # 4403
    ((44, 11252, 34531, 10903, 50), (-1.75, 0.25), -2.94),  # 4403
    ((289, 26459, 62934, 26379, 331), (-1.75, 0.25), 2.94),  # 6285
    # fastchess, with results that never occurred
    ((0, 0, 2, 0, 37), (0.0, 20.0), 2.96),
    ((0, 0, 1, 8, 1), (0.0, 50.0), 1.24),
]


@pytest.mark.parametrize(("pairs", "elo", "llr"), LOGISTIC)
def test_published_ratios_in_logistic_elo(pairs, elo, llr):
    assert float(SequentialTest(*elo).llr(pairs)) == pytest.approx(llr, abs=0.0051)


@pytest.mark.parametrize(("pairs", "elo", "llr"), NORMALIZED_ELO)
def test_published_ratios_in_normalised_elo(pairs, elo, llr):
    assert float(SequentialTest(*elo, model="normalized").llr(pairs)) == pytest.approx(llr, abs=0.0051)


def directly(counts: np.ndarray, holds: Callable[[np.ndarray], float]) -> float:
    """The highest log-likelihood under a constraint, less the highest of all, by a general optimiser."""
    shares = counts / counts.sum()

    def law(z):
        e = np.exp(z - z.max())
        return e / e.sum()

    found = []
    for start in (shares, np.full(5, 0.2), (shares + 0.2) / 2):
        solved = minimize(
            lambda z: -(shares @ np.log(law(z) + 1e-300)), np.log(start), method="SLSQP",
            constraints=[{"type": "eq", "fun": lambda z: holds(law(z))}], options={"maxiter": 1000, "ftol": 1e-15},
        )  # fmt: skip
        if abs(holds(law(solved.x))) < 1e-9:
            found.append(-solved.fun)
    return counts.sum() * (max(found) - shares @ np.log(shares))


@pytest.mark.parametrize("model", ["logistic", "normalized"])
@pytest.mark.parametrize("elo", [(0, 20), (-30, 50), (5, 100)])
@pytest.mark.parametrize("pairs", [(3, 10, 20, 14, 6), (0, 2, 9, 30, 12), (20, 10, 5, 2, 0), (0, 0, 0, 0, 12)])
def test_the_ratio_is_that_of_the_highest_likelihoods(pairs, elo, model: Model):
    def holds(at: float):
        if model == "logistic":
            return lambda p: p @ PAIR_SCORES - score_from_elo(at)
        t = math.sqrt(2) * at / NORMALIZED
        return lambda p: p @ PAIR_SCORES - 0.5 - t * math.sqrt(max(p @ (PAIR_SCORES - p @ PAIR_SCORES) ** 2, 1e-300))

    counts = np.where(np.array(pairs) > 0, pairs, NEVER)
    expected = directly(counts, holds(elo[1])) - directly(counts, holds(elo[0]))
    assert float(SequentialTest(*elo, model=model).llr(pairs)) == pytest.approx(expected, abs=2e-4)


@pytest.mark.parametrize("model", ["logistic", "normalized"])
def test_many_counts_at_once_give_what_each_gives_alone(model: Model):
    rng, test = np.random.default_rng(1), SequentialTest(-5, 25, model=model)
    counts = rng.integers(0, 30, (7, 3, 5))
    assert test.llr(counts) == pytest.approx(np.array([[float(test.llr(c)) for c in row] for row in counts]))


@pytest.mark.parametrize("model", ["logistic", "normalized"])
def test_seen_from_the_other_side_hypotheses_and_results_turn_round(model: Model):
    pairs = (4, 9, 20, 18, 7)
    there = float(SequentialTest(-10, 30, model=model).llr(pairs))
    assert float(SequentialTest(-30, 10, model=model).llr(pairs[::-1])) == pytest.approx(-there)


def test_bounds_and_decisions():
    test = SequentialTest(0, 20, alpha=0.05, beta=0.1)
    assert (test.lower, test.upper) == pytest.approx((math.log(0.1 / 0.95), math.log(0.9 / 0.05)))
    assert [test.result(pairs).decision for pairs in ((0, 0, 9, 0, 2), (5, 20, 60, 50, 30), (30, 50, 60, 20, 5))] == [
        "continue", "accept", "reject",
    ]  # fmt: skip


def test_what_was_measured_is_told_with_its_interval():
    found = SequentialTest(0, 20).result((0, 10, 20, 10, 10))
    assert found.elo == pytest.approx(400 * math.log10(0.6 / 0.4))
    assert 0 < found.low < found.elo < found.high < 200
    assert SequentialTest(0, 20, model="normalized").result((0, 10, 20, 10, 10))[4:] == found[4:]


def test_all_pairs_alike_and_no_pair_at_all_are_no_special_cases():
    drawn, won, none = (SequentialTest(0, 20).result(p) for p in ((0, 0, 50, 0, 0), (0, 0, 0, 0, 60), (0,) * 5))
    assert (drawn.elo, drawn.decision) == (0.0, "reject")
    assert drawn.low < 0 < drawn.high
    assert (won.elo, won.high, won.decision) == (math.inf, math.inf, "accept")
    assert won.low > 400
    assert (none.llr, none.decision) == (0.0, "continue")
    assert math.isnan(none.elo)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"elo0": 5, "elo1": 5}, "elo1: must be above elo0, which is 5"),
        ({"elo1": math.inf}, "elo1: must be above"),
        ({"elo0": math.nan}, "elo1: must be above"),
        ({"alpha": 0.0}, "alpha: must be between 0 and 1"),
        ({"alpha": 0.5, "beta": 0.5}, "beta: must be below 1 - alpha"),
        ({"model": "bayesian"}, "model: must be one of logistic, normalized"),
    ],
)
def test_a_test_that_decides_nothing_is_refused(given, says):
    with pytest.raises(ValueError, match=says):
        SequentialTest(**given)


@pytest.mark.parametrize("pairs", [(1, 2, 3, 4), (1, 2, -3, 4, 5), ()])
def test_counts_that_are_none_are_refused(pairs):
    with pytest.raises(ValueError, match="five counts, 0 or more each"):
        SequentialTest().llr(pairs)


def tilted(score: float) -> np.ndarray:
    """(5,) Shares of the five results with that mean, the likeliest next to those of two games that share a start."""
    shares = np.array([0.12, 0.2, 0.3, 0.23, 0.15])
    low, high = -20.0, 20.0
    for _ in range(100):
        x = (low + high) / 2
        law = shares * np.exp(x * PAIR_SCORES)
        law /= law.sum()
        low, high = (x, high) if law @ PAIR_SCORES < score else (low, x)
    return law


@pytest.mark.slow
@pytest.mark.parametrize("model", ["logistic", "normalized"])
@pytest.mark.parametrize("truth", ["elo0", "elo1"])
def test_whole_tests_err_about_as_often_as_they_may(truth, model: Model):
    test = SequentialTest(0, 50, alpha=0.05, beta=0.1, model=model)
    at = getattr(test, truth)
    if model == "normalized":  # the logistic Elo at which this law has that normalised one
        law = tilted(0.5)
        for _ in range(50):
            spread = math.sqrt(2 * (law @ (PAIR_SCORES - law @ PAIR_SCORES) ** 2))
            law = tilted(0.5 + at / NORMALIZED * spread)
    else:
        law = tilted(score_from_elo(at))
    rng = np.random.default_rng(7)
    n, every = (2000, 2) if model == "logistic" else (300, 20)  # the other ratio takes long
    counts, going = np.zeros((n, 5), int), np.arange(n)
    accepted = rejected = 0
    while going.size:
        counts[going] += rng.multinomial(every, law, going.size)
        llr = test.llr(counts[going])
        accepted, rejected = accepted + (llr >= test.upper).sum(), rejected + (llr <= test.lower).sum()
        going = going[(llr < test.upper) & (llr > test.lower)]
    wrong, allowed = (accepted, test.alpha) if truth == "elo0" else (rejected, test.beta)
    error = 3 * math.sqrt(allowed * (1 - allowed) / n)  # of this many simulated tests
    assert accepted + rejected == n
    assert (
        0.55 * allowed - error < wrong / n < allowed + error
    )  # overshooting the bounds makes it err less than allowed


def test_elo_and_scores_are_each_others_inverse():
    assert elo_from_score(score_from_elo(123.4)) == pytest.approx(123.4)
    assert elo_from_score(0.0) == -math.inf
