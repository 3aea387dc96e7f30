"""Rating of what a store holds, in this process and without training: batches of matches until enough is known.

Each batch has the most informative pairs (`matchmaking/match_selection.py`), as while a league runs; where all pairs
have met for `rating.episodes_per_pair` episodes, each meets for twice as many, and so on. Batches are filed with a
purpose of their own: they count for ratings like the league's, but take nothing of its time for rating, and neither
their keys nor their seeds are those of batches that the league has queued.
"""

import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

from league.config.experiment import Config
from league.matches.evaluator import MatchEvaluator
from league.queries.query import Open
from league.scheduling.match_scheduler import Lineup, complete, rating_job
from league.scheduling.progress_metrics import can_meet
from league.state.jobs import RatingMatch, decode
from league.state.league_state import LeagueState
from matchmaking.match_selection import pairings
from matchmaking.ratings.ladder import Ladder
from storage.records import Snapshot


class Done(NamedTuple):
    """Rating so far."""

    episodes: int  # played and filed
    widest: float | None  # Elo, the widest 95 % interval of a rating; None while a rating is not known
    ladder: Ladder
    repeated: int = 0  # episodes that were not filed, because another process had filed the same ones meanwhile

    @property
    def repetition(self) -> str:
        """A sentence about the episodes that were not filed; empty if there are none."""
        if not self.repeated:
            return ""
        return f"{self.repeated:,} more were not kept: another process played the same ones at the same time."


@dataclass(frozen=True)
class Limits:
    """Limits of rating, which ends at the first that is reached."""

    seconds: float
    episodes: int | None = None
    width: float | None = None  # Elo


def chosen(opened: Open, names: Collection[str]) -> list[Snapshot]:
    """Return the snapshots to play: those of these names and the initial ones, from which Elo counts; or all.

    Raises UnknownName, and StorageError for one that has been thinned.
    """
    every = opened.store.snapshots(opened.league, brief=True)
    if not names:
        return [s for s in every if s.thinned is None]
    found = {opened.snapshot(name).name for name in names}
    return [s for s in every if s.name in found or (s.initial and s.thinned is None)]


def rate(
    opened: Open, config: Config, evaluator: MatchEvaluator, players: list[Snapshot], limits: Limits
) -> Iterator[Done]:
    """Play batches among these snapshots and file them; yield the state before the first and after each."""
    store, began, episodes, repeated, state = opened.store, time.monotonic(), 0, 0, None
    while True:
        state = LeagueState.of(store, opened.league, state, arena=evaluator.key)
        widest = _widest(state.ladder, players)
        yield Done(episodes, widest, state.ladder, repeated)
        enough = limits.width is not None and widest is not None and widest <= limits.width
        spent = time.monotonic() - began >= limits.seconds
        if enough or spent or (limits.episodes is not None and episodes >= limits.episodes):
            return
        lineups = _lineups(state, players, config.rating.episodes_per_pair, evaluator.pairings)
        if not lineups:
            return
        job = rating_job(config, state, lineups, None, "request")
        task = decode(job)
        assert isinstance(task, RatingMatch)
        matches = evaluator.play(store, task)
        played = sum(m.episodes + m.voids for m in matches)
        if store.file(job, matches):
            episodes += played
        else:
            repeated += played


def _widest(ladder: Ladder, players: list[Snapshot]) -> float | None:
    """Return the widest 95 % interval in Elo, leaving out the snapshots that others are measured by."""
    if ladder.one_team or ladder.arena is None:
        return None
    rated = [s.name for s in players if s.name not in ladder.anchors]
    if not all(ladder.known(name) for name in rated):
        return None
    found = ladder.ratings
    return max((2 * float(found.quantile * found.stderr[ladder.payoff.index(name)]) for name in rated), default=0.0)


def _lineups(state: LeagueState, players: list[Snapshot], quota: int, room: int) -> list[Lineup]:
    """Return the lineups of the next batch; empty if none of these snapshots can meet."""
    if state.one_team:
        order = sorted(players, key=lambda s: state.ladder.trial_episodes(s.name))
        return [(s.name, None) for s in order[:room]]
    known = {s.name: s for s in players}

    def may_meet(a: str, b: str) -> bool:
        return can_meet(known[a], known[b], state.players)

    if not any(may_meet(a, b) for a in known for b in known if a < b):
        return []
    found: list[tuple[str, str]] = []
    among = replace(state, snapshots=players)
    while not found:
        found = pairings(
            state.ladder, list(known), quota=quota, per_batch=room, may_meet=may_meet,
            kinds={s.name: f"roster {s.roster}" for s in players},
        )  # fmt: skip
        quota *= 2
    return complete(found, among, quota)
