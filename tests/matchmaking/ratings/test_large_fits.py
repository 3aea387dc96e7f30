"""Fits of many snapshots by the pairs that met say what a fit in tables of all pairs says."""

import tracemalloc

import numpy as np
import pytest

from matchmaking import match_selection
from matchmaking.ratings.comparison import compare_pairs
from matchmaking.ratings.fit import Ratings, fit
from matchmaking.ratings.ladder import Ladder, Pool
from matchmaking.ratings.likelihoods import covariance, information, penalised
from matchmaking.ratings.likelihoods.undefeated import Unbounded
from matchmaking.ratings.payoff import sum_matches
from tests.matchmaking.conftest import make_match


def league(size: int, others: int, seed: int = 0) -> tuple[Pool, list]:
    """A lineage that grows, whose snapshots met their parent, the first, and others at random; and its log."""
    rng, names = np.random.default_rng(seed), [f"s{i:05}" for i in range(size)]
    strength = np.log2(1 + np.arange(size)) + rng.normal(0, 0.3, size)
    ends = [(i, j) for i in range(1, size) for j in {0, i - 1, *rng.integers(i, size=others).tolist()}]
    log = []
    for i, j in ends:
        sides = []
        for shift in (0.2, -0.2):
            win = 0.8 / (1 + np.exp(strength[j] - strength[i] - shift))
            sides.append(rng.multinomial(16, [win, 0.2, 0.8 - win]).tolist())
        log.append(make_match(names[i], names[j], *sides, pairs=(0, 0, 8, 4, 4)))
    return Pool(tuple(names), (names[0],), dict(zip(names[1:], names, strict=False))), log


@pytest.fixture
def sparse(monkeypatch):
    """No fit is small enough for tables of all pairs."""
    for module, name in ((penalised, "MAX_DENSE_FIT"), (information, "MAX_DENSE"), (covariance, "MAX_DENSE")):
        monkeypatch.setattr(module, name, -1)


@pytest.fixture(scope="module")
def both() -> tuple[Ratings, Ratings]:
    """The same fit in tables of all pairs, and by the pairs that met."""
    with pytest.MonkeyPatch.context() as patch:
        found = []
        for few, many in ((10**9, 10**9), (-1, -1)):
            patch.setattr(penalised, "MAX_DENSE_FIT", few)
            patch.setattr(information, "MAX_DENSE", many)
            patch.setattr(covariance, "MAX_DENSE", many)
            ratings = Ladder(*league(400, 2)).ratings
            _ = (
                ratings.stderr,
                ratings.side_stderr,
                ratings.strength_covariance.with_gaps(np.array([7]), np.array([9])),
                ratings.strength_covariance.of_sum(contrast(400)),
            )
            found.append(
                (
                    ratings,
                    ratings.covariances_of([3, 200, 399]),
                    ratings.covariances_with_gaps([7, 40, 3], [9, 41, 399]),
                    ratings.variance_of_gap(5, 300),
                )
            )
    return found


def contrast(size: int) -> np.ndarray:
    return np.eye(size)[3] - np.eye(size)[200]


def test_strengths_sides_and_draws_are_the_same(both):
    (dense, *_), (sparse, *_) = both
    assert sparse.elo == pytest.approx(dense.elo, abs=1e-4)
    assert sparse.side_advantage == pytest.approx(dense.side_advantage, abs=1e-5)
    assert sparse.draw == pytest.approx(dense.draw, rel=1e-7)
    assert sparse.log_likelihood == pytest.approx(dense.log_likelihood, rel=1e-10)
    assert sparse.side_stderr == pytest.approx(dense.side_stderr, rel=1e-5)


def test_single_covariances_are_the_same(both):
    (_, *dense), (_, *sparse) = both
    for one, other in zip(sparse, dense, strict=True):
        assert one == pytest.approx(other, rel=1e-5, abs=1e-4)


def test_comparisons_are_the_same(monkeypatch):
    ends = [(7, 9), (40, 41), (3, 399), (200, 100), (350, 175)]
    pairs = [(f"s{i:05}", f"s{j:05}") for i, j in ends]
    found = []
    for size in (10**9, -1):
        for module, name in ((penalised, "MAX_DENSE_FIT"), (information, "MAX_DENSE"), (covariance, "MAX_DENSE")):
            monkeypatch.setattr(module, name, size)
        found.append(compare_pairs(Ladder(*league(400, 2)), pairs, direct=False))
    for dense, sparse in zip(*found, strict=True):
        assert (sparse.first, sparse.sure) == (dense.first, dense.sure)
        assert (sparse.gap, sparse.error) == (pytest.approx(dense.gap, abs=1e-4), pytest.approx(dense.error, rel=1e-5))


def test_errors_are_estimated_to_a_few_per_cent(both):
    (dense, *_), (sparse, *_) = both
    off = sparse.stderr[1:] / dense.stderr[1:] - 1  # the first is the anchor
    assert sparse.stderr[0] == pytest.approx(dense.stderr[0], abs=1e-3)
    assert abs(off.mean()) < 0.01
    assert off.std() < 0.04
    assert np.abs(off).max() < 0.15


def test_errors_within_populations_are_estimated_too(monkeypatch):
    pool, log = league(120, 3)
    kinds = {name: (name[-1] in "02468" and "even") or "odd" for name in pool.names}
    log = [m for m in log if kinds[m.a] != kinds[m.b]]
    pool = Pool(pool.names, pool.names[:2], {}, kinds)
    dense = Ladder(pool, log).ratings
    expected, population_offset = dense.stderr, dense.population_offset("even", "odd")
    for module, name in ((penalised, "MAX_DENSE_FIT"), (information, "MAX_DENSE"), (covariance, "MAX_DENSE")):
        monkeypatch.setattr(module, name, -1)
    found = Ladder(pool, log).ratings
    assert found.stderr[2:] == pytest.approx(expected[2:], rel=0.15)
    assert found.population_offset("even", "odd") == pytest.approx(population_offset, rel=1e-4)


def test_no_table_of_all_pairs_is_made_of_thousands():
    pool, log = league(4000, 1)
    tracemalloc.start()
    ratings = Ladder(pool, log).ratings
    assert np.isfinite(ratings.stderr).all()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4000**2 * 8  # of one table


def test_a_prior_free_fit_is_as_finite_by_pairs(sparse):
    ring = [make_match(f"p{i:02}", f"p{(i + 1) % 20:02}", (5, 0, 3), (3, 0, 4)) for i in range(20)]
    found = fit(sum_matches(ring), prior=0, anchor_elo=0)
    assert np.isfinite(found.elo).all()
    assert found.elo.sum() == pytest.approx(0, abs=1e-6)
    with pytest.raises(Unbounded, match="'p00' is disconnected from 'new'"):
        fit(sum_matches([*ring, make_match("new", "q", (1, 0, 1))]), prior=0)
    with pytest.raises(Unbounded, match="undefeated"):
        fit(sum_matches([*ring, make_match("new", "p00", (1, 0, 0))]), prior=0)
    with pytest.raises(Unbounded, match="every game was drawn"):
        fit(sum_matches([make_match("a", "b", (0, 3, 0), (0, 2, 0))]), prior=0)


def test_parts_of_a_payoff_are_those_of_its_tables():
    payoff = Ladder(*league(30, 2)).payoff
    rows, columns = [3, 0, 29, 7], [7, 1, 3]
    place = np.ix_(rows, columns)
    voids = payoff.episodes - payoff.games
    for found, whole in zip(
        payoff.block(rows, columns), (payoff.wins, payoff.draws, payoff.losses, voids), strict=True
    ):
        assert np.array_equal(found, whole[place])
    tables = (payoff.wins, payoff.draws, payoff.losses)
    assert np.array_equal(payoff.results, np.stack([table.sum(1) for table in tables], 1))
    assert np.array_equal(payoff.total_episodes, payoff.episodes.sum(1))
    i, j = np.indices((30, 30))
    found = payoff.between(i, j)
    assert np.array_equal(found[..., 0], payoff.wins)
    assert np.array_equal(found[..., 2], payoff.losses)
    assert np.array_equal(found[..., 3:8], found.swapaxes(0, 1)[..., 3:8][..., ::-1])
    assert not sum_matches([]).block([], []).size


def test_of_many_candidates_the_newest_and_the_least_played_are_planned(monkeypatch):
    monkeypatch.setattr(match_selection, "MAX_CANDIDATES", 8)
    pool, log = league(40, 1)
    ladder = Ladder(Pool((*pool.names, "t0", "t1"), pool.anchors, pool.parents), log)
    names = ["t0", *pool.names[:20], "t1", *pool.names[20:]]
    plan = match_selection.pairings(ladder, names, quota=32, per_batch=4, always={pool.names[-1]: [pool.names[2]]})
    assert {"t0", "t1"} <= {name for pair in plan[:2] for name in pair}  # nobody has met them
    assert len(plan) == 4
    assert match_selection._components(ladder.payoff).tolist() == [0] * 40 + [40, 41]
    chosen = match_selection._shortlist(ladder.payoff, names, match_selection._components(ladder.payoff))
    assert len(chosen) == 8
    assert chosen[0] == "t0"
    assert "t1" in chosen
    assert chosen[-4:] == names[-4:]
    others = set(names[:-4]) - set(chosen)
    total_episodes = dict(zip(ladder.names, ladder.payoff.total_episodes.tolist(), strict=True))
    assert max(total_episodes[name] for name in chosen[:-4]) <= min(total_episodes[name] for name in others)
