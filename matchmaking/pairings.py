"""Which pairs of snapshots should be rated next: those whose games tell most.

Ratings compare only whom games connect, by whatever detour. So as long as games played or planned leave several parts
that could be joined, only pairs that join two are planned: first parts of several snapshots with the largest.

Again and again the candidate with the fewest episodes is chosen, the newest of those if they tie: everything plays
something before anything plays much. Its opponent is the first of its `always` list that it has not met for `quota`
episodes, else the candidate of whom a game tells most about the gap: a game's information is the variance of its score,
p(1-p), and what it adds to the knowledge of a gap of variance V grows with p(1-p) V (expected information gain, Lindley
1956). That prefers equals over the far, and the unknown over the known. A planned pair counts as `quota` episodes for
the rest of the batch, and as the information that they will give.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from matchmaking.ladder import Ladder
from matchmaking.payoff import Payoff
from matchmaking.ratings import ELO


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
    """The pairs of snapshots to be rated next, most useful first.

    Ties go to the newest, so the same arguments always give the same plan. Void episodes count as played, lest a pair
    that always fails be planned for ever. Where every pair has its quota, nothing is fitted.

    Args:
        ladder: what has been played, with a place for all names used here.
        candidates: snapshots that want a rating, oldest first.
        quota: episodes after which a pair is played enough.
        per_batch: at most so many pairs.
        always: snapshot -> opponents that it shall meet first, e.g. its player's initial snapshot, in order.
        may_meet: whether two snapshots can play each other at all, e.g. by their rosters; symmetric.
        kinds: snapshot -> its kind, where that decides who may meet: then one of each is asked for all.

    Returns:
        pairs (candidate, opponent), no pair twice and no one against itself; empty once every pair has its quota.
    """
    payoff = ladder.payoff
    newest_first = [payoff.index(name) for name in reversed(candidates)]
    first_of = {payoff.index(a): [payoff.index(b) for b in others] for a, others in (always or {}).items()}
    wanted = _wanted(payoff, newest_first, first_of, quota)
    wanted &= _able(payoff.names, wanted, kinds or {}, may_meet)
    if not wanted.any():
        return []
    knowledge, parts = _Knowledge(ladder), _parts(payoff)
    effort = payoff.episodes.sum(1).astype(float)
    required = np.zeros_like(wanted)
    for i, others in first_of.items():
        required[i, others] = True

    def opponent(i: int, open_: np.ndarray) -> int:
        first = [j for j in first_of.get(i, ()) if open_[j]]
        return first[0] if first else knowledge.most_telling(i, [j for j in newest_first if open_[j]])

    plan: list[tuple[str, str]] = []
    while len(plan) < per_batch and wanted.any():
        asked = _joining(wanted, parts, required)
        # The first of the newest among those of least effort; a candidate whose list asks for nobody is left out.
        i = min((i for i in newest_first if asked[i].any()), key=effort.__getitem__)
        j = opponent(i, asked[i])
        plan.append((payoff.names[i], payoff.names[j]))
        effort[[i, j]] += quota
        wanted[[i, j], [j, i]] = False  # never twice in a batch
        parts[parts == parts[j]] = parts[i]
        knowledge.expect(i, j, quota)
    return plan


def _wanted(
    payoff: Payoff,
    candidates: Sequence[int],
    always: Mapping[int, Sequence[int]],
    quota: int,
) -> np.ndarray:
    """(P, P) Whether candidate i asks for j: one it may choose, and has not met for `quota` episodes."""
    wanted = np.zeros(payoff.episodes.shape, bool)
    wanted[np.ix_(candidates, candidates)] = True
    for i in candidates:
        wanted[i, list(always.get(i, ()))] = True
    np.fill_diagonal(wanted, False)
    return wanted & (payoff.episodes < quota)


def _able(
    names: Sequence[str], wanted: np.ndarray, kinds: Mapping[str, str], may_meet: Callable[[str, str], bool]
) -> np.ndarray:
    """(P, P) Who may meet whom, of those that are wanted. A snapshot without a kind is one of its own."""
    _, first, kind = np.unique([kinds.get(name, name) for name in names], return_index=True, return_inverse=True)
    met = np.zeros((len(first), len(first)), bool)
    i, j = np.nonzero(wanted)
    met[kind[i], kind[j]] = True
    for a, b in np.argwhere(met).tolist():
        met[a, b] = may_meet(names[int(first[a])], names[int(first[b])])
    return met[kind[:, None], kind]


def _parts(payoff: Payoff) -> np.ndarray:
    """(P,) A number for each snapshot, the same for those whom games connect."""
    met, parts = payoff.games > 0, np.full(len(payoff.names), -1)
    for i in range(len(parts)):
        reached = np.array([i]) if parts[i] < 0 else np.zeros(0, int)
        while len(reached):
            parts[reached] = i
            reached = np.flatnonzero(met[reached].any(0) & (parts < 0))
    return parts


def _joining(wanted: np.ndarray, parts: np.ndarray, required: np.ndarray) -> np.ndarray:
    """(P, P) The wanted pairs that join two parts, the most urgent of them; all that are wanted where none does.

    Parts of several go to the largest one first; then single snapshots to it, or to whom they are `required` to meet.
    """
    size = np.bincount(parts, minlength=len(parts))[parts]
    largest = (parts == parts[size.argmax()]) & (size > 1)
    apart = (size > 1) & ~largest
    joins = parts[:, None] != parts
    for urgent in (apart[:, None] & largest, joins & (largest | required), joins):
        if (found := wanted & urgent).any():
            return found
    return wanted


class _Knowledge:
    """What is known of the gaps between snapshots, and will be once the planned games have been played."""

    def __init__(self, ladder: Ladder):
        chance = ladder.ratings.expected_scores()
        self._information = chance * (1 - chance)  # of one game, in (log odds)⁻²
        self._covariance = ladder.ratings.covariance / ELO**2

    def most_telling(self, i: int, others: Sequence[int]) -> int:
        """Of whom one game against i tells most; the first of them if they tie."""
        c = self._covariance
        gain = self._information[i] * (c[i, i] + np.diag(c) - 2 * c[i])
        rounded = np.round(gain, 6)  # so that the last bits of the linear algebra do not break ties
        return max(others, key=rounded.__getitem__)

    def expect(self, i: int, j: int, games: int) -> None:
        """Count on so many games between i and j, by the Sherman-Morrison formula."""
        shared = self._covariance[i] - self._covariance[j]
        expected = games * self._information[i, j]
        self._covariance = self._covariance - np.outer(shared, shared) * expected / (
            1 + expected * (shared[i] - shared[j])
        )
