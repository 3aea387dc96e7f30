"""Gains of training: each player's newest rated snapshot against the one at half of its training."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

from league.queries.query import score_text
from league.queries.ratings.evidence import short_evidence
from league.state.league_state import LeagueState
from matchmaking.ratings.comparison import compare_pairs
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
    halves = {name: _halves([s for s in state.history(name) if _rated(ladder, s.name)]) for name in trained}
    pairs = {name: pair for name, pair in halves.items() if pair is not None}
    unknown = [Gain(n, "unknown", f"{n}: too few of its snapshots are rated.") for n in trained if n not in pairs]
    found = [_success_gain(ladder, *each) for each in pairs.items()] if ladder.one_team else _gains(ladder, pairs)
    return sorted([*found, *unknown], key=lambda gain: ORDER.index(gain.kind))


def _halves(rated: Sequence[Snapshot]) -> tuple[str, str] | None:
    """Return the newest snapshot, and the one at half of its steps or the first; None for fewer than two."""
    if len(rated) < 2:
        return None
    newest = rated[-1]
    before = max((s for s in rated[:-1] if s.step <= newest.step / 2), key=lambda s: s.step, default=rated[0])
    return newest.name, before.name


def _success_gain(ladder: Ladder, player: str, pair: tuple[str, str]) -> Gain:
    newest, before = pair
    now, then = ladder.success(newest), ladder.success(before)
    kind = "better" if now.low > then.high else "worse" if now.high < then.low else "open"
    return Gain(player, kind, f"{newest} succeeds in {score_text(now)}, {before} in {score_text(then)}.")


def _gains(ladder: Ladder, pairs: Mapping[str, tuple[str, str]]) -> Iterator[Gain]:
    compared = compare_pairs(ladder, list(pairs.values()))
    for (player, (newest, before)), found in zip(pairs.items(), compared, strict=True):
        if not found.sure:
            text = f"{newest} is not known to be stronger than {before}: {found.first} {short_evidence(found)}."
            yield Gain(player, "open", text)
        else:
            kind = "better" if found.first == newest else "worse"
            yield Gain(player, kind, f"{found.first} is stronger than {found.second}: it {short_evidence(found)}.")


def _rated(ladder: Ladder, name: str) -> bool:
    return ladder.trial_episodes(name) > 0 if ladder.one_team else ladder.known(name)
