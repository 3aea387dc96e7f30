"""Comparison of two snapshots: one is called stronger only if that holds although the rating model misfits.

A rating is one number. Results may also have a part that no number expresses: A beats B, B beats C, C beats A. A
statement has to hold even if this cyclic term is as large as `CYCLIC_ELO` for some pairs. The term is assumed to be
that of a disc game (Balduzzi et al. 2019) whose angles are spread over the circle, so its mean square over pairs is

    τ² = CYCLIC_ELO² / 2

and a gap of two ratings determines their score against each other only up to τ, however many games others played.

The rule, for snapshots A and B:

1. If the two have met for at least `MIN_DIRECT_GAMES` games, those games alone decide: they include the cyclic term of
   this pair. A is stronger if the 95 % interval of its score lies above one half.
2. Otherwise the fit decides, with an interval that is widened by the misfit. The gap of every pair e that has met has
   an error of its own, of variance τ², besides that of chance. With the covariance C of the fit and w_e = n p (1 - p)
   the information of the pair's games, errors of the pairs spread into the ratings as C M C, where M is the Laplacian
   of the weights w_e² τ² (the sandwich of White 1982 again). The pair's own cyclic term is added:

     variance of the gap = c' (C + C M C) c + τ²,   c = 1 for A, -1 for B

   A is stronger if gap > 1.96 √variance.
3. Otherwise it is unknown which is stronger.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from matchmaking.ratings.davidson import expected_score
from matchmaking.ratings.fit import ELO
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.scores import Score, quantile

CYCLIC_ELO = 100.0
"""Elo: amplitude of the cyclic term that the model cannot express and a statement has to survive."""
MIN_DIRECT_GAMES = 100
"""Games between two snapshots from which on these games alone decide."""
CLOSE = 1e-4
"""Relative error of the covariances; that of a gap's variance is far smaller, and no verdict is so near."""


class Comparison(NamedTuple):
    """Result of comparing two snapshots."""

    first: str  # the one that is ahead
    second: str
    sure: bool  # first is stronger, by the rule of this module
    direct: bool  # the games between the two decide; otherwise the fit
    score: Score  # of first, in the games between the two; nan if they have not met
    gap: float  # Elo by the fit, first minus second
    error: float  # half the 95 % interval of the gap, widened by the misfit


def compare_snapshots(ladder: Ladder, a: str, b: str, direct: bool = True) -> Comparison:
    """Return which of two snapshots is ahead, and if that is sure.

    Without `direct` the fit decides, whatever games the two have played. Raises ValueError for a name that is not on
    the ladder.
    """
    return compare_pairs(ladder, [(a, b)], direct)[0]


def compare_pairs(ladder: Ladder, pairs: Sequence[tuple[str, str]], direct: bool = True) -> list[Comparison]:
    """Return the comparison of each pair, as `compare_snapshots` does; of many snapshots faster than one by one."""
    if not pairs:
        return []
    ratings = ladder.ratings
    first, second = ([ratings.index(pair[k]) for pair in pairs] for k in (0, 1))
    gaps = ratings.strength[first] - ratings.strength[second]
    errors = quantile(0.95) * np.sqrt(_variances(ladder, first, second))
    return [
        _comparison(ladder, *pair, float(gap), float(error), direct)
        for pair, gap, error in zip(pairs, gaps, errors, strict=True)
    ]


def _comparison(ladder: Ladder, a: str, b: str, gap: float, error: float, direct: bool) -> Comparison:
    score = ladder.score(a, b)
    direct = direct and score.games >= MIN_DIRECT_GAMES
    ahead = score.score >= 0.5 if direct else gap >= 0
    if not ahead:
        a, b, gap, score = b, a, -gap, ladder.score(b, a)
    sure = score.low > 0.5 if direct else gap > error
    return Comparison(a, b, sure, direct, score, gap, error)


def _variances(ladder: Ladder, first: Sequence[int], second: Sequence[int]) -> np.ndarray:
    """Return the variances (K,) in Elo² of K gaps between two snapshots each that the fit predicts; see the module."""
    payoff, ratings, misfit = ladder.payoff, ladder.ratings, CYCLIC_ELO**2 / 2
    gaps = ratings.strength[payoff.first] - ratings.strength[payoff.second]
    ahead, behind = (expected_score((sign * gaps + ratings.side_advantage) / ELO, ratings.draw) for sign in (1, -1))
    chance = (ahead + 1 - behind) / 2
    games = payoff.home.sum(1) + payoff.away.sum(1)
    information = games * chance * (1 - chance) / ELO**2
    found = []
    for i, j, with_gap in zip(first, second, ratings.covariances_with_gaps(first, second, CLOSE).T, strict=True):
        errors = misfit * (information * (with_gap[payoff.first] - with_gap[payoff.second])) ** 2
        found.append(with_gap[i] - with_gap[j] + errors.sum() + misfit)
    return np.array(found)
