"""Which parameters have no finite value by the games alone: by hand, and against linear programmes."""

import numpy as np
import pytest

from matchmaking import graph_algorithms
from matchmaking.ratings.davidson import Likelihood
from matchmaking.ratings.likelihoods import priors
from matchmaking.ratings.payoff import sum_matches
from matchmaking.ratings.separation import BOUNDS, find_separation


def separation(log, sides=True, players=()):
    return find_separation(Likelihood.of(sum_matches(log, players), priors.none(), sides))


def home_wins(match, *pairs):
    return [match(*pair, home=(1, 0, 0)) for pair in pairs]


def test_games_that_tell_everything_leave_nothing_unbounded(match):
    found = separation([match(a, b, home=(2, 1, 1), away=(1, 1, 1)) for a, b in ("ab", "bc")])
    assert found.finite
    assert (found.side, found.draw, found.ratings, found.islands) == (None, False, (None,) * 3, 1)


def test_a_log_whose_first_column_is_the_winner_says_nothing_of_ratings(match):
    log = home_wins(match, "ab", "ba", "bc", "cb", "ca")
    found = separation(log)
    assert (found.side, found.draw, found.ratings) == ("above", False, ("both",) * 3)
    assert found.unknown.all()
    assert separation(log, sides=False).finite
    loser_first = [match(a, b, home=(0, 0, 1)) for a, b in ("ab", "ba", "bc", "cb", "ca")]
    assert separation(loser_first).side == "below"


def test_where_the_first_wins_or_draws_both_terms_grow_and_ratings_may_stay(match):
    log = [match(a, b, home=(3, 2, 0)) for a, b in ("ab", "ba", "bc", "cb")]
    found = separation(log)
    assert (found.side, found.draw, found.ratings) == ("above", True, (None,) * 3)
    assert not separation(log, sides=False).side


@pytest.mark.parametrize(
    ("rows", "draw"),
    [
        ([("a", "b", (0, 4, 0)), ("b", "c", (0, 4, 0)), ("c", "a", (0, 4, 0))], True),  # everything was drawn
        ([("a", "b", (0, 4, 0)), ("b", "c", (2, 0, 0)), ("a", "c", (2, 0, 0))], True),
        ([("a", "b", (0, 4, 0)), ("b", "c", (2, 0, 0)), ("c", "a", (1, 0, 2))], False),
        ([("a", "b", (3, 0, 3)), ("b", "c", (3, 0, 3)), ("c", "a", (3, 0, 3))], False),  # no draw, so ν is 0
    ],
)
def test_draws_in_every_game_of_a_pair_or_in_none(match, rows, draw):
    assert separation([match(a, b, home=counts) for a, b, counts in rows], sides=False).draw is draw


def test_who_is_undefeated_or_winless_has_a_bound_on_one_side(match):
    even = [match(a, b, home=(2, 0, 2), away=(2, 0, 2)) for a, b in ("ab", "bc", "ac")]
    found = separation([*even, *home_wins(match, "xa", "by", "xc")])
    assert dict(zip("abcxy", found.ratings, strict=True)) == {
        "a": None, "b": None, "c": None, "x": "above", "y": "below"
    }  # fmt: skip
    assert (found.side, found.unknown.any()) == (None, False)
    ladder = separation(home_wins(match, "ab", "bc"), sides=False)  # no two of them compare
    assert ladder.ratings == ("above", "both", "below")


def test_islands_are_numbered_by_size_and_who_has_not_played_is_on_none(match):
    even = [match(a, b, home=(1, 0, 1), away=(1, 0, 1)) for a, b in ("ab", "cd", "de")]
    found = separation(even, players=["z"])
    assert found.island.tolist() == [2, 2, 1, 1, 1, 0]
    assert (found.islands, found.ratings) == (2, (None,) * 6)


def extremes(problem):
    """Return bounds of γ and of ν, and (P, P) whether i may rise against j without end, by linear programmes."""
    from scipy.optimize import linprog

    P, rows, unit = problem.size, [], np.eye(problem.size + 2)
    for i, j, counts in zip(problem.home, problem.away, problem.counts, strict=True):
        gap = unit[i] - unit[j] + problem.free[P] * unit[P]
        outcomes = {0: gap / 2, 2: -gap / 2} | ({1: unit[P + 1]} if problem.free[P + 1] else {})
        rows += [outcomes[k] - other for k in outcomes if counts[k] for other in outcomes.values()]
    A = np.array(rows)

    def grows(c):
        return -linprog(-c, A_ub=-A, b_ub=np.zeros(len(A)), bounds=(-1, 1)).fun > 1e-7

    side = grows(unit[P]) + 2 * grows(-unit[P]) if problem.free[P] else 0
    rises = np.array([[i != j and grows(unit[i] - unit[j]) for j in range(P)] for i in range(P)])
    return BOUNDS[side], bool(problem.free[P + 1] and grows(unit[P + 1])), rises


def drawn_up(match, rng):
    """A few games of up to five players; in some logs draws or losses at home are rare."""
    n, kind, log = rng.integers(2, 6), rng.integers(4), []
    for _ in range(rng.integers(3, 12)):
        counts = rng.integers(0, 2, 3) * (rng.integers(0, 2, 3) if kind else 1)
        counts = counts * {2: (1, 1, 0), 3: (1, 0, rng.random() < 0.2)}.get(int(kind), (1, 1, 1))
        log.append(match(*map(str, rng.choice(n, 2, replace=False)), home=counts))
    return [m for m in log if m.wins + m.draws + m.losses]


def test_a_linear_programme_says_the_same_of_each_parameter(match):
    rng, seen = np.random.default_rng(0), set()
    for _ in range(120):
        if not (log := drawn_up(match, rng)):
            continue
        problem = Likelihood.of(sum_matches(log), priors.none(), bool(rng.integers(4)))
        found, (side, draw, rises) = find_separation(problem), extremes(problem)
        assert (found.side, found.draw) == (side, draw)
        seen.add((side, draw))
        for number in range(1, found.islands + 1):
            own = np.flatnonzero(found.island == number)
            alike = ~(rises | rises.T)[np.ix_(own, own)]
            largest = alike.sum(1).max()
            ratings = [found.ratings[i] for i in own]
            if largest > 1:  # against a player of the, or of a, largest group
                against = [own[i] for i in np.flatnonzero(alike.sum(1) == largest)]
                assert ratings in [[BOUNDS[rises[i, r] + 2 * rises[r, i]] for i in own] for r in against]
            elif len(own) > 1:
                assert all(ratings)
    assert len(seen) > 5


def test_ten_thousand_players_are_examined_at_once(match):
    rng, P = np.random.default_rng(0), 10_000
    home = np.repeat(np.arange(P), 4)
    away = (home + rng.integers(1, 60, len(home))) % P
    one = np.concatenate([np.ones((len(home), 1)), np.zeros((len(home), 2))], 1)
    free = np.append(np.ones(P + 1, bool), False)
    found = find_separation(Likelihood(P, home, away, one, priors.none(), free))
    assert (found.side, found.islands, found.unknown.all()) == ("above", 1, True)


def test_strong_components_and_difference_constraints():
    source, target = np.array([0, 1, 2, 2, 3, 5]), np.array([1, 2, 0, 3, 4, 5])
    labels = graph_algorithms.strong_components(6, source, target)
    assert labels[0] == labels[1] == labels[2]
    assert len(set(labels[2:].tolist())) == 4
    assert graph_algorithms.connected(6, source, target).tolist() == [0, 0, 0, 0, 0, 5]
    rng = np.random.default_rng(0)
    for _ in range(50):
        ends = rng.integers(0, 7, (12, 2))
        weight = rng.integers(-3, 6, 12)
        found = graph_algorithms.solve(7, *ends.T, weight)
        if isinstance(found, graph_algorithms.Cycle):
            cycle = ends[found.edges]
            assert weight[found.edges].sum() < 0
            assert sorted(cycle[:, 0]) == sorted(cycle[:, 1])
        else:
            assert (found[ends[:, 1]] - found[ends[:, 0]] <= weight).all()


def test_the_side_may_only_grow_as_fast_as_draws_let_it(match):
    """a beat b at home, and both drew with c: γ may fall, by no more than ν rises."""
    found = separation(
        [match("a", "b", home=(1, 0, 0)), match("a", "c", home=(0, 1, 0)), match("b", "c", home=(0, 1, 0))]
    )
    assert (found.side, found.draw) == ("both", True)
