"""Test of whether a player has learnt enough, by its rated snapshots, and choice of its best snapshot.

A snapshot counts after `rating.episodes_per_pair` episodes that measure progress: alone in an arena of one team, else
against its initial opponents. The best snapshot has the highest lower end of the 95 % interval, since the highest of
many scores is often due to luck.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from league.config.experiment import Config
from league.config.sections import Budget, Rating
from league.scheduling.progress_metrics import initial_opponents
from league.state.league_state import LeagueState
from matchmaking.ratings.scores import Score
from storage.records import Player, Snapshot

HALF = 0.5
"""Lower end of the interval above which a constant score is a plateau; below, the player has not begun to learn."""
LAST = 2
"""Number of newest snapshots of which one must be rated before an older one counts as better: else ratings lag."""


class Rated(NamedTuple):
    """A snapshot, and its success rate alone or its score against its initial opponents."""

    snapshot: Snapshot
    score: Score

    def describe(self, state: LeagueState) -> str:
        """Return the rating as a sentence, e.g. `blue@64 scores 83 % (80-86 %) against its initial snapshot`."""
        return f"{self.snapshot.name} {self.how(state)}"

    def how(self, state: LeagueState) -> str:
        """Return the score and its interval in words."""
        share = f"{100 * self.score.score:.0f} % ({100 * self.score.low:.0f}-{100 * self.score.high:.0f} %)"
        if state.one_team:
            return f"succeeds in {share}"
        others = initial_opponents(self.snapshot, state.snapshots, state.players)
        others_text = (
            "its initial snapshot" if all(o.player == self.snapshot.player for o in others) else "initial opponents"
        )
        return f"scores {share} against {others_text}"


def rated(state: LeagueState, player: str, quota: int) -> list[Rated]:
    """Return a player's snapshots that have played their quota, with their scores, oldest first."""
    ladder, found = state.ladder, []
    for snapshot in state.history(player):
        if snapshot.name not in ladder.names:
            continue
        if state.one_team:
            episodes, score = ladder.trial_episodes(snapshot.name), ladder.success(snapshot.name)
        else:
            others = [o.name for o in initial_opponents(snapshot, state.snapshots, state.players)]
            payoff = ladder.payoff
            at = [payoff.index(name) for name in others if name in ladder.names]
            episodes = int(payoff.episodes[payoff.index(snapshot.name), at].sum()) if at else 0
            score = ladder.score(snapshot.name, *others) if at else None
        if score is not None and episodes >= quota and score.games:
            found.append(Rated(snapshot, score))
    return found


def best(found: Sequence[Rated]) -> Rated | None:
    """Return the snapshot with the highest lower end, the newest of equal ones; None if `found` is empty."""
    return max(found, key=lambda each: (each.score.low, each.snapshot.iteration), default=None)


def why(budget: Budget, quota: int, state: LeagueState, player: Player) -> str | None:
    """Return the evidence that a player has learnt what its budget requires, as a sentence; None without evidence."""
    found = rated(state, player.name, quota)
    top = best(found)
    if top is None:
        return None
    asked = budget.success if state.one_team else budget.score
    if asked is not None and top.score.low > asked:
        return top.describe(state)
    later = sum(each.snapshot.iteration > top.snapshot.iteration for each in found)
    if budget.plateau is not None and top.score.low > HALF and later >= budget.plateau:
        return f"{top.describe(state)}, and none of the {later} snapshots after it is better"
    return None


def learnt_enough(config: Config, state: LeagueState, players: Sequence[Player]) -> bool:
    """Return whether these players have learnt what the budget requires: all by ratings, or all by reward."""
    budget = config.budget
    by_rating = budget.by_rating and all(
        why(budget, config.rating.episodes_per_pair, state, p) is not None for p in players
    )
    by_reward = budget.reward is not None and all(
        state.rewards.get(p.name, -math.inf) >= budget.reward for p in players
    )
    return by_rating or by_reward


def handed_on(state: LeagueState, player: str, quota: int = Rating().episodes_per_pair) -> Rated | None:
    """Return the snapshot that another league starts from, if that is not the player's newest state.

    Return None if the newest rated snapshot is the best, if none of the LAST newest snapshots is rated, and if no rated
    snapshot still has its policy.
    """
    newest = {s.name for s in state.history(player)[-LAST:]}
    found = rated(state, player, quota)
    if not found or found[-1].snapshot.name not in newest:
        return None
    top = best([each for each in found if each.snapshot.thinned is None])
    return None if top is None or top.snapshot.name == found[-1].snapshot.name else top
