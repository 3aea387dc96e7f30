"""The league's tables as data frames: what the commands print as text, and what `league.open` gives.

Reads the store and nothing else: neither jax nor torch nor mujoco is loaded.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np

from league.course import at_work
from league.measures import score_against_initial
from matchmaking.ladder import Ladder
from matchmaking.payoff import Score, score_interval
from storage.errors import StorageError, UnknownName
from storage.records import RATED, ArenaKey, CurvePoint, Match, Player, Snapshot
from storage.store import Store

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]
R = TypeVar("R", int, float, str)
VOID_LIMIT = 0.02
"""Where a league's settings do not say (`rating.void_limit`) from which share on void episodes are suspect."""


class Open:
    """A league opened for reading: `ratings()`, `matches()`, `snapshots()` and `curves()` are data frames."""

    def __init__(self, store: Store, league: str | None = None):
        self.store = store
        self.league = at_work(store, league or only_league(store))
        store.league(self.league)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.store.close()

    def ratings(self, arena: str | None = None, engine: str | None = None) -> "pd.DataFrame":
        """A row per snapshot, best first, on one ladder: name, player, iteration, elo, low, high, episodes, ...

        The ladder is that of the newest rating matches, of those in `arena` and under `engine` if given. Elo is fitted
        anew from all its matches; the mean of the players' initial snapshots is 1000. low and high bound 95 % for the
        difference to that mean, and `known` is false where that is too wide to say anything. `score` is over all its
        episodes, draws half; `vs_initial` as league.measures defines it. In an arena of one team there is a `success`
        rate instead. `flagged` marks those whose void episodes exceed the league's `rating.void_limit`: "!" if by
        their own robots, "?" if perhaps. Raises StorageError where there is no such ladder.
        """
        import pandas as pd

        ladder = self.ladder(choose(self.ladders(), arena, engine))
        frozen, players = self.store.snapshots(self.league), self.store.players(self.league)
        return pd.DataFrame(rating_rows(ladder, frozen, players, self.void_limit()))

    def matches(self) -> "pd.DataFrame":
        """A row per batch of episodes: who met whom, wins, draws, losses and voids counted for a, seed, recording."""
        import pandas as pd

        return pd.DataFrame(match_rows(self.store.matches(self.league)))

    def snapshots(self) -> "pd.DataFrame":
        """A row per snapshot: those of no player first, then by iteration."""
        import pandas as pd

        return pd.DataFrame(snapshot_rows(self.store.snapshots(self.league)))

    def curves(self, player: str | None = None) -> "pd.DataFrame":
        """A row per player and learning iteration: steps, seconds, and every figure recorded of it, nan where not.

        Raises UnknownName for a player that the league does not have.
        """
        import pandas as pd

        return pd.DataFrame(curve_rows(self.points(player)))

    def points(self, player: str | None = None) -> list[CurvePoint]:
        """The learning curves as the store has them, of all players or of one."""
        players = [p.name for p in self.store.players(self.league)]
        if player is not None and player not in players:
            raise UnknownName("player", player, players)
        return self.store.curves(self.league, player)

    def ladders(self) -> list[ArenaKey]:
        """The keys under which rating matches were played, those of the newest matches first."""
        return ladders(self.store.matches(self.league, RATED))

    def ladder(self, key: ArenaKey | None) -> Ladder:
        """The ladder of a key, with a place for every snapshot; an empty one for None."""
        log = [m for m in self.store.matches(self.league, RATED) if m.arena == key]
        snapshots = self.store.snapshots(self.league)
        return Ladder([s.name for s in snapshots], log, [s.name for s in snapshots if s.initial])

    def void_limit(self) -> float:
        """The league's `rating.void_limit`, read without what a whole configuration needs, such as its arena's file."""
        return self.setting("rating", "void_limit", otherwise=VOID_LIMIT)

    def setting(self, *key: str, otherwise: R) -> R:
        """One of the league's settings, `setting("rating", "quota", otherwise=128)`, where its text has that."""
        import tomllib

        try:
            value: Any = tomllib.loads(self.store.league(self.league).config)
            for name in key:
                value = value[name]
            return type(otherwise)(value)
        except (tomllib.TOMLDecodeError, KeyError, TypeError, ValueError):
            return otherwise


def only_league(store: Store) -> str:
    """The league a store is about when none is named: its only one, else the one that was run last."""
    leagues = store.leagues()
    if not leagues:
        raise StorageError(f"{store.where} holds no league yet: `league run` makes one.")
    last_run = {league.name: max((run.id for run in store.runs(league.name)), default=0) for league in leagues}
    return max(leagues, key=lambda league: last_run[league.name]).name


def ladders(matches: Iterable[Match]) -> list[ArenaKey]:
    """The keys of a match log, those of the newest matches first."""
    newest = {m.arena: m.id for m in matches}  # a later match replaces an earlier one
    return sorted(newest, key=lambda key: -newest[key])


def choose(keys: Sequence[ArenaKey], arena: str | None = None, engine: str | None = None) -> ArenaKey | None:
    """The first of the keys that fits; None where nothing is asked for and nothing was played.

    Raises StorageError, with those there are, where none fits.
    """
    fitting = [key for key in keys if arena in (None, key.arena) and engine in (None, key.engine)]
    if not fitting and (arena or engine):
        asked = " ".join(filter(None, (arena and f"in arena {arena!r}", engine and f"under engine {engine!r}")))
        there = ", ".join(dict.fromkeys(f"{key.arena} under {key.engine}" for key in keys)) or "none"
        raise StorageError(f"No rating match was played {asked}; there are: {there}.")
    return fitting[0] if fitting else None


def rating_rows(
    ladder: Ladder, snapshots: Sequence[Snapshot], players: Sequence[Player], void_limit: float = VOID_LIMIT
) -> list[Row]:
    """See Open.ratings. Those whose rating is not known come after the others, and those that never played last."""
    rows = []
    for s in snapshots:
        i = ladder.ratings.index(s.name)
        met, success, voids = bool(ladder.ratings.games[i]), ladder.success(s.name), ladder.void_rate(s.name)
        initial = score_against_initial(ladder, s, snapshots, players)
        rows.append({
            "name": s.name, "player": s.player, "iteration": s.iteration if s.player else None,
            "seconds": round(s.seconds, 1) if s.player else None,
            "elo": float(ladder.ratings.elo[i]) if met else None,
            "low": float(ladder.ratings.low[i]) if met else None,
            "high": float(ladder.ratings.high[i]) if met else None, "known": ladder.known(s.name),
            "episodes": int(ladder.ratings.games[i]) + success.games,
            "score": float(ladder.ratings.score[i]) if met else None,
            "vs_initial": initial.score if initial else None,
            "vs_initial_low": initial.low if initial else None, "vs_initial_high": initial.high if initial else None,
            "success": success.score if success.games else None,
            "success_low": success.low if success.games else None,
            "success_high": success.high if success.games else None,
            "voids_own": voids.own, "voids_unclear": voids.unclear,
            "flagged": "!" if voids.own > void_limit else "?" if voids.suspect > void_limit else "",
            "digest": s.digest, "roster": s.roster,
            **(ladder.arena or ArenaKey("", "", ""))._asdict(),
        })  # fmt: skip
    merit = "success" if ladder.one_team else "elo"

    def place(row: Row) -> tuple:
        unsure = not (row["known"] or ladder.one_team)
        return row[merit] is None, unsure, -(row[merit] or 0.0), row["player"] or "", row["iteration"] or 0, row["name"]

    return sorted(rows, key=place)


def unlike_sides(players: Sequence[Player]) -> list[str]:
    """The rosters of the teams in their order, where these are unlike; none where all are of one roster."""
    rosters = list(dict.fromkeys(p.roster for p in sorted(players, key=lambda p: p.team)))
    return rosters if len(rosters) > 1 else []


def side_score(ladder: Ladder, snapshots: Iterable[Snapshot], one: str, other: str) -> Score:
    """How one roster has scored against another in all their games: role and skill in one, of whoever has played."""
    payoff, rosters = ladder.payoff, {s.name: s.roster for s in snapshots}
    met = np.ix_(*([rosters.get(name) == roster for name in payoff.names] for roster in (one, other)))
    wins, draws, losses = (int(counts[met].sum()) for counts in (payoff.wins, payoff.draws, payoff.losses))
    low, high = score_interval(wins, draws, losses)
    games = wins + draws + losses
    return Score((wins + draws / 2) / games if games else float("nan"), float(low), float(high), games)


def side_text(roster: str) -> str:
    """A roster as people say it, e.g. `3 × predator`."""
    counts = Counter(agent.partition(":")[0] for agent in roster.split("+"))
    return " + ".join(f"{count} × {kind}" for kind, count in counts.items())


def match_rows(matches: Iterable[Match]) -> list[Row]:
    """See Open.matches."""
    return [
        {
            "match": m.id, "a": m.a, "b": m.b, "wins": m.wins, "draws": m.draws, "losses": m.losses, "voids": m.voids,
            "voids_a": m.voids_a, "voids_b": m.voids_b,
            "score": (m.wins + m.draws / 2) / played if (played := m.wins + m.draws + m.losses) else None,
            "seed": m.seed, "steps": m.steps, "purpose": m.purpose, "recorded": m.recording is not None,
            "recording": m.recording, **m.arena._asdict(), "created": m.created,
        }
        for m in matches
    ]  # fmt: skip


def snapshot_rows(snapshots: Iterable[Snapshot]) -> list[Row]:
    """See Open.snapshots."""
    return [
        {
            "name": s.name, "player": s.player, "script": s.script, "origin": s.origin, "parent": s.parent,
            "initial": s.initial, "iteration": s.iteration, "steps": s.step, "seconds": round(s.seconds, 1),
            "roster": s.roster, "digest": s.digest, "arena": s.arena.arena if s.arena else None,
            "engine": s.arena.engine if s.arena else None, "created": s.created,
        }
        for s in snapshots
    ]  # fmt: skip


def curve_rows(points: Iterable[CurvePoint]) -> list[Row]:
    """See Open.curves."""
    return [
        {"player": p.player, "iteration": p.iteration, "steps": p.step, "seconds": round(p.seconds, 3), **p.values}
        for p in points
    ]


def score_text(score: Score) -> str:
    """A score with its 95 % interval, e.g. `97.3 % (95.8-98.4) of 512`."""
    return f"{100 * score.score:.1f} % ({100 * score.low:.1f}-{100 * score.high:.1f}) of {score.games}"
