"""Gains of training: each player's newest rated snapshot against the one at half of its training."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

from league.queries.query import score_text
from league.queries.ratings.evidence import short_evidence
from league.state.league_state import LeagueState
from matchmaking.ratings.comparison import compare_snapshots
from matchmaking.ratings.ladder import Ladder
from storage.records import Snapshot

ORDER = ("worse", "open", "unknown", "better")


class Gain(NamedTuple):
    """A player's gain over the second half of its training so far."""

    player: str
    kind: Literal["better", "worse", "open", "unknown"]
    text: str


def gains(ladder: Ladder, state: LeagueState) -> list[Gain]:
    """Return the gain of each player that has been trained: losses and doubts first."""
    trained = [p.name for p in state.players if p.name in state.checkpoints and state.checkpoints[p.name].iteration]
    found = [_gain(ladder, name, state.history(name)) for name in trained]
    return sorted(found, key=lambda gain: ORDER.index(gain.kind))


def _gain(ladder: Ladder, player: str, history: Sequence[Snapshot]) -> Gain:
    rated = [s for s in history if _rated(ladder, s.name)]
    if len(rated) < 2:
        return Gain(player, "unknown", f"{player}: too few of its snapshots are rated.")
    newest = rated[-1]
    before = max((s for s in rated[:-1] if s.step <= newest.step / 2), key=lambda s: s.step, default=rated[0])
    if ladder.one_team:
        now, then = ladder.success(newest.name), ladder.success(before.name)
        kind = "better" if now.low > then.high else "worse" if now.high < then.low else "open"
        text = f"{newest.name} succeeds in {score_text(now)}, {before.name} in {score_text(then)}."
        return Gain(player, kind, text)
    found = compare_snapshots(ladder, newest.name, before.name)
    if not found.sure:
        text = f"{newest.name} is not known to be stronger than {before.name}: {found.first} {short_evidence(found)}."
        return Gain(player, "open", text)
    kind = "better" if found.first == newest.name else "worse"
    return Gain(player, kind, f"{found.first} is stronger than {found.second}: it {short_evidence(found)}.")


def _rated(ladder: Ladder, name: str) -> bool:
    return ladder.trial_episodes(name) > 0 if ladder.one_team else ladder.known(name)
