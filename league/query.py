"""The league's tables as data frames: what `league ratings`, `matches`, `snapshots` print and `league.open` gives.

Reads the store and nothing else: neither jax nor torch nor mujoco is loaded.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

from matchmaking.payoff import Score, tally
from matchmaking.ratings import Ratings, fit
from storage.errors import StorageError
from storage.records import Match, Snapshot
from storage.store import Store

if TYPE_CHECKING:
    import pandas as pd

ANCHOR_ELO = 1000.0


class Open:
    """A league opened for reading: `ratings()`, `matches()`, `snapshots()` are data frames."""

    def __init__(self, store: Store, league: str | None = None):
        self.store = store
        self.league = league or only_league(store)
        store.league(self.league)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.store.close()

    def ratings(self) -> "pd.DataFrame":
        """A row per snapshot, best first: name, player, iteration, seconds, elo, low, high, episodes, score, ...

        Elo is fitted anew from all rating matches; the mean of the players' initial snapshots is 1000. low and high
        bound 95 % for the difference to that mean. `score` is over all its episodes, draws half; `vs_initial` against
        its player's initial snapshot.
        """
        import pandas as pd

        return pd.DataFrame(rating_rows(self.store.snapshots(self.league), self.store.matches(self.league, "rating")))

    def matches(self) -> "pd.DataFrame":
        """A row per batch of episodes: who met whom, wins, draws, losses and voids counted for a, seed, recording."""
        import pandas as pd

        return pd.DataFrame(match_rows(self.store.snapshots(self.league), self.store.matches(self.league)))

    def snapshots(self) -> "pd.DataFrame":
        """A row per snapshot, oldest first."""
        import pandas as pd

        return pd.DataFrame(snapshot_rows(self.store.snapshots(self.league)))


def only_league(store: Store) -> str:
    """The league a store is about when none is named: its only one, else the one that was run last."""
    leagues = store.leagues()
    if not leagues:
        raise StorageError(f"{store.where} holds no league yet: `league run` makes one.")
    last_run = {league.name: max((run.id for run in store.runs(league.name)), default=0) for league in leagues}
    return max(leagues, key=lambda league: last_run[league.name]).name


def rated(snapshots: Sequence[Snapshot], matches: Sequence[Match]) -> Ratings:
    """The fit of all rating matches, anchored at the players' initial snapshots."""
    initial = [s.digest for s in snapshots if s.player and s.iteration == 0]
    payoff = tally(matches, players=[s.digest for s in snapshots])
    return fit(payoff, anchors=initial, anchor_elo=ANCHOR_ELO)


def rating_rows(snapshots: Sequence[Snapshot], matches: Sequence[Match]) -> list[dict]:
    """See Open.ratings. Snapshots that have played no episode are listed last, without a rating."""
    if not snapshots:
        return []
    payoff = tally(matches, players=[s.digest for s in snapshots])
    ratings = rated(snapshots, matches)
    first = {s.player: s.digest for s in snapshots[::-1] if s.player and s.iteration == 0}
    rows = []
    for s in snapshots:
        i = ratings.index(s.digest)
        met = int(ratings.games[i]) > 0
        start = first.get(s.player or "")
        against = payoff.score(s.digest, start) if start and start != s.digest else None
        rows.append({
            "name": s.name, "player": s.player, "iteration": s.iteration if s.player else None,
            "seconds": round(s.seconds, 1) if s.player else None,
            "elo": float(ratings.elo[i]) if met else None, "low": float(ratings.low[i]) if met else None,
            "high": float(ratings.high[i]) if met else None, "episodes": int(ratings.games[i]),
            "score": float(ratings.score[i]) if met else None,
            "vs_initial": against.score if against and against.games else None, "digest": s.digest,
        })  # fmt: skip
    return sorted(rows, key=lambda row: (row["elo"] is None, -(row["elo"] or 0.0), row["name"]))


def match_rows(snapshots: list[Snapshot], matches: list[Match]) -> list[dict]:
    """See Open.matches."""
    names = {s.digest: s.name for s in snapshots}
    return [
        {
            "match": m.id, "a": names.get(m.a, m.a), "b": names.get(m.b, m.b), "wins": m.wins, "draws": m.draws,
            "losses": m.losses, "voids": m.voids,
            "score": (m.wins + m.draws / 2) / played if (played := m.wins + m.draws + m.losses) else None,
            "seed": m.seed, "steps": m.steps, "purpose": m.purpose, "recorded": m.recording is not None,
            "recording": m.recording, "arena": m.arena.arena, "engine": m.arena.engine, "created": m.created,
        }
        for m in matches
    ]  # fmt: skip


def snapshot_rows(snapshots: list[Snapshot]) -> list[dict]:
    """See Open.snapshots."""
    return [
        {
            "name": s.name, "player": s.player, "script": s.script, "iteration": s.iteration, "steps": s.step,
            "seconds": round(s.seconds, 1), "roster": s.roster, "digest": s.digest, "created": s.created,
        }
        for s in snapshots
    ]  # fmt: skip


def score_text(score: Score) -> str:
    """A score with its 95 % interval, e.g. `97.3 % (95.8-98.4) of 512`."""
    return f"{100 * score.score:.1f} % ({100 * score.low:.1f}-{100 * score.high:.1f}) of {score.games}"
