"""Selection of the pairs of snapshots to rate next: those whose games are most informative.

Ratings compare only snapshots that games connect, directly or indirectly. So as long as the games played or planned
leave several components that could be connected, only pairs that connect two are planned: first components of several
snapshots with the largest.

Each step chooses the candidate with the fewest episodes, the newest of those in a tie: everything plays something
before anything plays much. Its opponent is the first of its `always` list that it has not met for `quota` episodes,
otherwise the candidate whose games are most informative about the gap: a game's information is the variance of its
score, p(1-p), and what it adds to the knowledge of a gap of variance V grows with p(1-p) V (expected information gain,
Lindley 1956). That prefers equals over distant snapshots, and unknown over known ones. A planned pair counts as `quota`
episodes for the rest of the batch, and as the information that they will give. Below K is the number of snapshots
considered.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from matchmaking.ratings.fit import ELO
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.payoff import Payoff

MAX_CANDIDATES = 400
"""Maximum number of candidates considered: a plan for all pairs of 10,000 would take a minute and gigabytes."""


def pairings(
    ladder: Ladder,
    candidates: Sequence[str],
    *,
    quota: int,
    per_batch: int,
    always: Mapping[str, Sequence[str]] | None = None,
    may_meet: Callable[[str, str], bool] = lambda a, b: True,
    kinds: Mapping[str, str] | None = None,
) -> list[tuple[str, str]]:
    """Return the pairs of snapshots to rate next, most useful first.

    Ties go to the newest, so the same arguments always give the same plan. Void episodes count as played, so that a
    pair that always fails is not planned for ever. If every pair has its quota, nothing is fitted.

    Args:
        ladder: of the games played so far, with a position for all names used here.
        candidates: snapshots to rate, oldest first.
        quota: episodes after which a pair is played enough.
        per_batch: maximum number of pairs.
        always: snapshot -> opponents that it has to meet first, e.g. its player's initial snapshot, in order.
        may_meet: True if two snapshots can play each other at all, e.g. by their rosters; symmetric.
        kinds: snapshot -> its kind, if `may_meet` depends on that alone: then one of each kind is asked for all.

    Returns:
        pairs (candidate, opponent), none twice and none of equal names; empty once every pair has its quota.
    """
    always = always or {}
    component = _components(ladder.payoff)
    candidates = _shortlist(ladder.payoff, candidates, component)
    names = sorted({*candidates, *(name for a, others in always.items() for name in (a, *others))})
    place = {name: i for i, name in enumerate(names)}
    newest_first = [place[name] for name in reversed(candidates)]
    first_of = {place[a]: [place[b] for b in others] for a, others in always.items()}
    chosen = np.array([ladder.payoff.index(name) for name in names], int)
    wanted = _wanted(ladder.payoff.episodes_between(chosen[:, None], chosen), newest_first, first_of, quota)
    wanted &= _allowed(names, wanted, kinds or {}, may_meet)
    if not wanted.any():
        return []
    plan = _Plan(ladder, chosen, component, wanted, newest_first, first_of)
    pairs: list[tuple[str, str]] = []
    while len(pairs) < per_batch and plan.wanted.any():
        i, j = plan.next_pair()
        pairs.append((names[i], names[j]))
        plan.add(i, j, quota)
    return pairs


class _Plan:
    """State of a batch that is being planned: open pairs, episodes, components and knowledge with the games planned."""

    def __init__(
        self,
        ladder: Ladder,
        chosen: np.ndarray,
        component: np.ndarray,
        wanted: np.ndarray,
        newest_first: Sequence[int],
        first_of: Mapping[int, Sequence[int]],
    ):
        self.wanted = wanted  # (K, K) bool: open pairs
        self._newest_first, self._first_of = newest_first, first_of
        self._episodes = ladder.payoff.total_episodes[chosen].astype(float)
        self._component = component[chosen]  # (K,)
        self._size = np.bincount(component, minlength=len(component))  # of each component
        self._required = np.zeros_like(wanted)
        for i, others in first_of.items():
            self._required[i, others] = True
        self._knowledge = _GapKnowledge(ladder, chosen)

    def next_pair(self) -> tuple[int, int]:
        """Return the most useful open pair: a candidate and its opponent, by position."""
        wanted = _connecting(self.wanted, self._component, self._size, self._required)
        # The newest of those with the fewest episodes, among candidates that have an open pair.
        i = min((i for i in self._newest_first if wanted[i].any()), key=self._episodes.__getitem__)
        for j in self._first_of.get(i, ()):
            if wanted[i, j]:
                return i, j
        return i, self._knowledge.most_informative(i, [j for j in self._newest_first if wanted[i, j]])

    def add(self, i: int, j: int, quota: int) -> None:
        """Count a planned pair as `quota` episodes and as the information that they will give."""
        self._episodes[[i, j]] += quota
        self.wanted[[i, j], [j, i]] = False  # never twice in a batch
        one, other = self._component[i], self._component[j]
        if one != other:
            self._size[one] += self._size[other]
            self._component[self._component == other] = one
        self._knowledge.add_games(i, j, quota)


def _shortlist(payoff: Payoff, candidates: Sequence[str], parts: np.ndarray) -> Sequence[str]:
    """Return the candidates to consider: all, or beyond MAX_CANDIDATES the newest and the least played.

    In the second half, candidates outside the largest component come first.
    """
    if len(candidates) <= MAX_CANDIDATES:
        return candidates
    newest = len(candidates) - MAX_CANDIDATES // 2
    places = np.array([payoff.index(name) for name in candidates[:newest]], int)
    largest = np.bincount(parts).argmax()
    order = np.lexsort((-np.arange(newest), payoff.total_episodes[places], parts[places] == largest)).tolist()
    least = sorted(order[: MAX_CANDIDATES - MAX_CANDIDATES // 2])
    return [candidates[int(i)] for i in [*least, *range(newest, len(candidates))]]


def _wanted(
    episodes: np.ndarray,
    candidates: Sequence[int],
    always: Mapping[int, Sequence[int]],
    quota: int,
) -> np.ndarray:
    """Return the open pairs (K, K) bool: candidate i may choose j, and has not met it for `quota` episodes."""
    wanted = np.zeros(episodes.shape, bool)
    wanted[np.ix_(candidates, candidates)] = True
    for i in candidates:
        wanted[i, list(always.get(i, ()))] = True
    np.fill_diagonal(wanted, False)
    return wanted & (episodes < quota)


def _allowed(
    names: Sequence[str], wanted: np.ndarray, kinds: Mapping[str, str], may_meet: Callable[[str, str], bool]
) -> np.ndarray:
    """Return the pairs (K, K) bool that may meet, among those wanted. A snapshot without a kind is its own kind."""
    _, first, kind = np.unique([kinds.get(name, name) for name in names], return_index=True, return_inverse=True)
    met = np.zeros((len(first), len(first)), bool)
    i, j = np.nonzero(wanted)
    met[kind[i], kind[j]] = True
    for a, b in np.argwhere(met).tolist():
        met[a, b] = may_meet(names[int(first[a])], names[int(first[b])])
    return met[kind[:, None], kind]


def _components(payoff: Payoff) -> np.ndarray:
    """Return a number (P,) for each snapshot, the same for those that games connect: the smallest index among them."""
    met = (payoff.home + payoff.away).any(1)
    first, second, parts = payoff.first[met], payoff.second[met], np.arange(len(payoff.names))
    while (parts[first] != parts[second]).any():
        least = np.minimum(parts[first], parts[second])
        for ends in (first, second):
            np.minimum.at(parts, parts[ends], least)
        while (parts != (further := parts[parts])).any():
            parts = further
    return parts


def _connecting(wanted: np.ndarray, parts: np.ndarray, sizes: np.ndarray, required: np.ndarray) -> np.ndarray:
    """Return the most urgent wanted pairs (K, K) that connect two components; all wanted pairs if none does.

    Components of several snapshots go to the largest one first; then single snapshots go to it, or to opponents that
    they are `required` to meet.
    """
    size = sizes[parts]
    largest = (parts == parts[size.argmax()]) & (size > 1)
    apart = (size > 1) & ~largest
    joins = parts[:, None] != parts
    for urgent in (apart[:, None] & largest, joins & (largest | required), joins):
        if (found := wanted & urgent).any():
            return found
    return wanted


class _GapKnowledge:
    """Knowledge of the gaps between snapshots after the games played and planned."""

    def __init__(self, ladder: Ladder, chosen: np.ndarray):
        chance = ladder.ratings.expected_between(chosen)
        self._information = chance * (1 - chance)  # of one game, in (log odds)⁻²
        self._covariance = ladder.ratings.covariances_of(chosen) / ELO**2

    def most_informative(self, i: int, others: Sequence[int]) -> int:
        """Return the one of `others` against which a game of i is most informative; the first of them in a tie."""
        c = self._covariance
        gain = self._information[i] * (c[i, i] + np.diag(c) - 2 * c[i])
        rounded = np.round(gain, 6)  # so that the last bits of the linear algebra do not break ties
        return max(others, key=rounded.__getitem__)

    def add_games(self, i: int, j: int, games: int) -> None:
        """Update the covariance by planned games between i and j, with the Sherman-Morrison formula."""
        shared = self._covariance[i] - self._covariance[j]
        expected = games * self._information[i, j]
        self._covariance = self._covariance - np.outer(shared, shared) * expected / (
            1 + expected * (shared[i] - shared[j])
        )
