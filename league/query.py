"""The league's tables as data frames: what the commands print as text, and what `league.open` gives.

Reads the store and nothing else: neither jax nor torch nor mujoco is loaded.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar

from league.course import at_work
from league.rated import VOID_LIMIT, Row, chosen, moment, rating_rows
from matchmaking.ladder import Ladder, Pool
from matchmaking.payoff import Score
from storage.errors import StorageError, UnknownName
from storage.records import RATED, ArenaKey, CurvePoint, Match, Player, Snapshot
from storage.store import Store

if TYPE_CHECKING:
    import pandas as pd

    from matchmaking.roles import Role

R = TypeVar("R", int, float, str, list)


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

    def ratings(
        self,
        arena: str | None = None,
        engine: str | None = None,
        team: str | None = None,
        role: str | None = None,
        as_of: str | None = None,
    ) -> "pd.DataFrame":
        """A row per snapshot, best first, on one ladder: rank, player, name, role, elo, low, high, games, ...

        The ladder is that of the newest rating matches, of those in `arena` and under `engine` if given, as it stood at
        the end of `as_of` (a date or time in ISO 8601, UTC); of its rows those of a `team` or a `role`, if given.

        Elo is fitted anew from all its matches; the mean of the players' initial snapshots is 1000. low and high bound
        95 % for the difference to that mean, and `known` is false where that is too wide to say anything; `rank` counts
        those that are known. Where teams' rosters are unlike, Elo and rank are of a snapshot's own side, and `tilt` is
        what to add to compare it with one of the other side; else it is 0. `games` were `wins`, `draws` and `losses`;
        `voids` count for nobody. `win_rate` is over all its games, draws half; `vs_initial` alike, as league.measures
        defines it: against its own initial snapshot where rosters are alike. In an arena of one team there is a
        `success` rate instead. `flagged` marks those whose void episodes exceed the league's `rating.void_limit`: "!"
        if by their own robots, "?" if perhaps.

        Raises StorageError where there is no such ladder, UnknownName for a team or role that there is not, ValueError
        for an `as_of` that is no date.
        """
        import pandas as pd

        shown = self.shown(arena, engine, None if as_of is None else moment(as_of))
        rows = rating_rows(shown.ladders[0], shown.snapshots, shown.players, shown.void_limit)
        return pd.DataFrame(chosen(rows, shown.players, self.teams(), team, role))

    def shown(
        self, arena: str | None = None, engine: str | None = None, as_of: float | None = None, all: bool = False
    ) -> "Shown":
        """The ladder that fits, or all that do, as of a time on the database's clock. Raises StorageError for none."""
        totals, players = self.store.totals(self.league, RATED, as_of), self.store.players(self.league)
        snapshots = [s for s in self.store.snapshots(self.league) if as_of is None or s.created <= as_of]
        pool, keys = Pool.of(snapshots, players), list(totals)
        first = choose(keys, arena, engine)
        wanted = [key for key in keys if arena in (None, key.arena) and engine in (None, key.engine)]
        wanted = wanted if all else wanted[:1]
        ladders = [Ladder(pool, totals[key]) for key in wanted] or [Ladder(pool)]
        return Shown(first, ladders, [key for key in keys if key not in wanted], snapshots, players, self.void_limit())

    def teams(self) -> dict[str, int]:
        """The words for a team: its number, its players' names, and its name where the settings list players."""
        found: dict[str, int] = {}
        players = {p.name: p.team for p in self.store.players(self.league)}
        seen = Counter[str]()
        for entry in self.setting("players", otherwise=[]):
            if team := str(entry.get("team", "")):
                seen[team] += 1
                name = entry.get("name") or (team if seen[team] == 1 else f"{team}-{seen[team]}")
                found |= {team: players[name]} if name in players else {}
        return found | players | {str(team): team for team in players.values()}

    def matches(self) -> "pd.DataFrame":
        """A row per batch of episodes: who met whom, wins, draws, losses and voids counted for a, seed, recording."""
        import pandas as pd

        return pd.DataFrame(match_rows(self.store.matches(self.league)))

    def snapshot(self, name: str) -> Snapshot:
        """A snapshot that is there to play, by its name, or a player's newest by the player's.

        Raises UnknownName, StorageError where it has been thinned.
        """
        known = {s.name: s for s in self.store.snapshots(self.league)}
        of_player = [s for s in known.values() if s.player == name]
        found = known.get(name) or max(of_player, key=lambda s: s.iteration, default=None)
        if found is None:
            raise UnknownName("snapshot", name, known)
        require_whole(found, known.values())
        return found

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
        return list(self.store.totals(self.league, RATED))

    def ladder(self, key: ArenaKey | None) -> Ladder:
        """The ladder of a key, with a place for every snapshot; an empty one for None."""
        pool = Pool.of(self.store.snapshots(self.league), self.store.players(self.league))
        log = self.store.totals(self.league, RATED).get(key) if key is not None else None
        return Ladder(pool, log or ())

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
        except (ValueError, RecursionError, KeyError, TypeError):
            return otherwise

    def roles(self) -> Callable[[str], "Role"]:
        """The league's roles by their names, with nothing left open. Raises ConfigError for settings that are none."""
        from league.config import toml
        from league.config.build import build
        from matchmaking.opponents import Opponents
        from matchmaking.roles import Role, role_named

        settings = toml.parse(self.store.league(self.league).config, f"league {self.league}")
        declared = [build(Role, table) for table in settings.get("roles", ())]
        otherwise = build(Opponents, settings.get("training", {}).get("opponents", {}))
        return lambda name: role_named(name, declared, otherwise)


class Shown(NamedTuple):
    """Ladders of a league, and what their rows tell beside results."""

    key: ArenaKey | None  # of the first; None where nothing was played
    ladders: list[Ladder]
    others: list[ArenaKey]  # of the ladders that are not shown
    snapshots: list[Snapshot]
    players: list[Player]
    void_limit: float


def only_league(store: Store) -> str:
    """The league a store is about when none is named: its only one, else the one that was run last."""
    leagues = store.leagues()
    if not leagues:
        raise StorageError(f"{store.where} holds no league yet: `league run` makes one.")
    last_run = {league.name: max((run.id for run in store.runs(league.name)), default=0) for league in leagues}
    return max(leagues, key=lambda league: last_run[league.name]).name


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


def require_whole(snapshot: Snapshot, others: Iterable[Snapshot]) -> None:
    """Raise StorageError, with who of its player can play instead, where a snapshot has been thinned."""
    if snapshot.thinned is None:
        return
    able = [s for s in others if s.player == snapshot.player and s.thinned is None]
    near = sorted(able, key=lambda s: abs(s.iteration - snapshot.iteration))[:2]
    instead = " or ".join(s.name for s in sorted(near, key=lambda s: s.iteration))
    raise StorageError(
        f"{snapshot.name} of league {snapshot.league} has been thinned: its matches count, but its policy is gone."
        f" Take {instead} instead."
    )


def match_rows(matches: Iterable[Match]) -> list[Row]:
    """See Open.matches. Who played in training is no snapshot: `blue@32+` is blue some time after blue@32."""
    return [
        {
            "match": m.id, "a": _called(m, m.a), "b": _called(m, m.b),
            "wins": m.wins, "draws": m.draws, "losses": m.losses, "voids": m.voids,
            "voids_a": m.voids_a, "voids_b": m.voids_b,
            "score": (m.wins + m.draws / 2) / played if (played := m.wins + m.draws + m.losses) else None,
            "seed": m.seed, "steps": m.steps, "purpose": m.purpose, "recorded": m.recording is not None,
            "recording": m.recording, **m.arena._asdict(), "created": m.created,
        }
        for m in matches
    ]  # fmt: skip


def _called(match: Match, name: str | None) -> str | None:
    return f"{name}+" if name and match.purpose == "training" else name


def snapshot_rows(snapshots: Iterable[Snapshot]) -> list[Row]:
    """See Open.snapshots."""
    return [
        {
            "name": s.name, "player": s.player, "script": s.script, "origin": s.origin, "parent": s.parent,
            "initial": s.initial, "iteration": s.iteration, "steps": s.step, "seconds": round(s.seconds, 1),
            "roster": s.roster, "digest": s.digest, "arena": s.arena.arena if s.arena else None,
            "engine": s.arena.engine if s.arena else None, "created": s.created, "thinned": s.thinned,
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
