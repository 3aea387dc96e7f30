"""Required matches of the newest snapshots: the part of the match design that is planned before the pool.

A question about the newest snapshots is answered by games that they play themselves. Games of the pool answer it
indirectly, and each link of the chain adds its own error and that of the model. So every newest snapshot has a list of
opponents, and all go through their lists side by side, in rounds: in the first round the first opponent of every list
comes before any second one. Then the newest play each other to the end, and then the next round follows.

`experiments/designs.py` compares this with other designs at equal numbers of games (`docs/ratings.md` has the figures).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from matchmaking.ratings.payoff import Payoff

HISTORY_OFFSETS = (3, 10)
"""Numbers of snapshots back at which a newest snapshot meets its own past, besides its parent."""


@dataclass(frozen=True)
class RequiredOpponents:
    """Opponents that a newest snapshot has to meet, the most important first; repeated names count once."""

    rivals: Sequence[str] = ()  # newest snapshots of other players
    measures: Sequence[str] = ()  # initial snapshots, parent, its own past
    anchors: Sequence[str] = ()  # milestones, scripts, imports

    @property
    def order(self) -> list[str]:
        """One rival, then the measures, then all other rivals, then the anchors."""
        return list(dict.fromkeys([*self.rivals[:1], *self.measures, *self.rivals[1:], *self.anchors]))


def others_after(newest: Sequence[str], name: str) -> list[str]:
    """Return all other newest snapshots, starting after `name`, so that first opponents form different pairs."""
    at = newest.index(name)
    return [*newest[at + 1 :], *newest[:at]]


def missing_pairs(
    payoff: Payoff, required: Mapping[str, RequiredOpponents], *, quota: int, target_episodes: int | None = None
) -> list[tuple[str, str]]:
    """Return the pairs of newest snapshots and opponents that still have to meet, most urgent first.

    Args:
        payoff: of the games played so far, with a position for all names used here.
        required: newest snapshot -> its required opponents. A pair that both sides list is returned once.
        quota: episodes of one round, void ones included. A pair that has played n rounds waits for all that have
            played fewer, except rivals: their later rounds come before the second round of others.
        target_episodes: episodes after which a pair has met enough; None for one round.

    Returns:
        pairs (newest, opponent), none twice and none of equal names; empty once all have met enough.
    """
    found: dict[frozenset[str], tuple[tuple[int, bool, int, int], tuple[str, str]]] = {}
    for order, (name, own) in enumerate(required.items()):
        others = own.order
        at = np.array([payoff.index(other) for other in others], int)
        played = payoff.episodes_between(np.array(payoff.index(name)), at).tolist()
        for place, (other, episodes) in enumerate(zip(others, played, strict=True)):
            if other == name or episodes >= (quota if target_episodes is None else target_episodes):
                continue
            done = episodes // quota
            early = done > 0 and other in own.rivals
            entry = (1 if early else done, not early, place, order), (name, other)
            pair = frozenset(entry[1])
            found[pair] = min(found.get(pair, entry), entry)
    return [pair for _, pair in sorted(found.values())]
