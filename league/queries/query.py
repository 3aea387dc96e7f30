"""The league's tables as data frames, which the commands print as text and `league.open` gives.

Only the store is read: neither jax nor torch nor mujoco is loaded.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple, Self

from league.config.schema import ConfigError
from league.queries.league_settings import LeagueSettings, R
from league.queries.ratings.rating_rows import VOID_LIMIT, Row, chosen, moment, rating_rows, when
from league.state.curriculum_stage import at_work
from league.state.void_rates import names as cause_names
from league.system.provenance import LINE, code_of
from matchmaking.ratings.ladder import Ladder, Pool
from matchmaking.ratings.scores import Score
from storage.errors import NoLeague, StorageError, UnknownName
from storage.records import RATED_PURPOSES, ArenaKey, CurvePoint, Match, Player, RankedMatch, Snapshot
from storage.store import Store

if TYPE_CHECKING:
    from datetime import date

    import pandas as pd

    from matchmaking.roles import Role

MATCH_COLUMNS = (
    "match", "a", "b", "wins", "draws", "losses", "voids", "voids_a", "voids_b", "score", "void_causes", "seed",
    "steps", "purpose", "recorded", "recording", "arena", "config_hash", "engine", "created",
)  # fmt: skip
"""Columns of matches of two teams."""


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
        as_of: "str | date | None" = None,
    ) -> "pd.DataFrame":
        """Return a row per snapshot, best first, on one ladder: rank, player, name, role, elo, low, high, games, ...

        The ladder is that of the newest rating matches, of those in `arena` and under `engine` if given, at the end
        of `as_of` (a date, or a time, also in ISO 8601; UTC). With `team` or `role`, only rows of that team or role.

        Elo is fitted anew from all matches of the ladder; the mean of the players' initial snapshots is 1000. low and
        high are the 95 % interval of the difference to that mean, and `known` is false if the interval is too wide to
        be useful; `rank` counts known ratings, by `low`. `opponents` is the number of opponents met; if they are few,
        the rating is `provisional`. If the teams' rosters differ, Elo and rank are those within a snapshot's own side,
        and `tilt` is the amount to add for a comparison with a snapshot of the other side; otherwise it is 0. `games`
        is the sum of `wins`, `draws` and `losses`; `voids` count for nobody. `win_rate` is over all games, a draw
        counts half; `vs_initial` likewise, as defined in league.scheduling.progress_metrics: against the snapshot's own
        initial snapshot if rosters are alike. In an arena of one team there is a `success` rate instead. `flagged`
        marks snapshots whose void episodes exceed the league's `rating.void_limit`: "!" if their own robots caused
        them, "?" if perhaps.

        Raises StorageError if there is no such ladder, or was no snapshot then, UnknownName for an unknown team or
        role, ConfigError for an `as_of` that is not a date.
        """
        import pandas as pd

        try:
            until = None if as_of is None else moment(as_of)
        except ValueError as error:
            raise ConfigError(("as_of",), f"as_of = {as_of!r:.40}: {error}") from None
        shown = self.shown(arena, engine, until)
        rows = rating_rows(shown.ladders[0], shown.snapshots, shown.players, shown.void_limit)
        return pd.DataFrame(chosen(rows, shown.players, self.teams(), team, role))

    def shown(
        self, arena: str | None = None, engine: str | None = None, as_of: float | None = None, all: bool = False
    ) -> "Shown":
        """Return the first matching ladder, or all, as of a time on the database's clock.

        Raises StorageError if none matches, or the league had no snapshot yet.
        """
        totals, players = self.store.totals(self.league, RATED_PURPOSES, as_of), self.store.players(self.league)
        every = self.store.snapshots(self.league, brief=True)
        snapshots = [s for s in every if as_of is None or s.created <= as_of]
        if as_of is not None and every and not snapshots:
            first = when(min(s.created for s in every))
            raise StorageError(f"League {self.league} had no snapshot yet at {when(as_of)}; its first is of {first}.")
        pool, keys = Pool.of(snapshots, players), list(totals)
        first = choose(keys, arena, engine)
        wanted = [key for key in keys if arena in (None, key.arena) and engine in (None, key.engine)]
        wanted = wanted if all else wanted[:1]
        ladders = [Ladder(pool, totals[key]) for key in wanted] or [Ladder(pool)]
        return Shown(first, ladders, [key for key in keys if key not in wanted], snapshots, players, self.void_limit())

    def teams(self) -> dict[str, int]:
        """Map the words for a team to it: its number, its players' names, and its name if the settings list players."""
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
        """Return a row per batch of episodes: players a and b, a's wins, draws, losses and voids, seed, recording.

        Matches of three and more teams have a `lineup`, the snapshot of each team, with the numbers of `rankings` and
        the `mean_ranks` of the teams, and no a and b.
        """
        return match_frame(self.store.log(self.league))

    def snapshot(self, name: str) -> Snapshot:
        """Return a snapshot that can play, by its own name or by that of the player whose newest it is.

        Raises UnknownName; StorageError if the snapshot has been thinned.
        """
        known = {s.name: s for s in self.store.snapshots(self.league, brief=True)}
        of_player = [s for s in known.values() if s.player == name]
        found = known.get(name) or max(of_player, key=lambda s: s.iteration, default=None)
        if found is None:
            raise UnknownName("snapshot", name, known)
        require_whole(found, known.values())
        return self.store.snapshots(self.league, named=[found.name])[0]

    def snapshots(self) -> "pd.DataFrame":
        """Return a row per snapshot: those of no player first, then by iteration."""
        import pandas as pd

        ends = self.store.settings_ends(self.league, LINE)
        return pd.DataFrame(snapshot_rows(self.store.snapshots(self.league, brief=True), ends))

    def curves(self, player: str | None = None) -> "pd.DataFrame":
        """Return a row per player and learning iteration: steps, seconds and every recorded metric, nan if missing.

        Raises UnknownName for a player that the league does not have.
        """
        import pandas as pd

        return pd.DataFrame(curve_rows(self.points(player)))

    def points(self, player: str | None = None) -> list[CurvePoint]:
        """Return the learning curves in the store, of all players or of one."""
        players = [p.name for p in self.store.players(self.league)]
        if player is not None and player not in players:
            raise UnknownName("player", player, players)
        return self.store.curves(self.league, player)

    def ladders(self) -> list[ArenaKey]:
        """Return the keys under which rating matches were played, those of the newest matches first."""
        return list(self.store.totals(self.league, RATED_PURPOSES))

    def ladder(self, key: ArenaKey | None) -> Ladder:
        """Return the ladder of a key, with a place for every snapshot; an empty ladder for None."""
        pool = Pool.of(self.store.snapshots(self.league, brief=True), self.store.players(self.league))
        log = self.store.totals(self.league, RATED_PURPOSES).get(key) if key is not None else None
        return Ladder(pool, log or ())

    def void_limit(self) -> float:
        """Return the league's `rating.void_limit`, read without a whole configuration, which needs the arena's file."""
        return self.setting("rating", "void_limit", otherwise=VOID_LIMIT)

    def settings(self) -> LeagueSettings:
        """Return the league's present settings in the store."""
        return LeagueSettings(self.league, self.store.league(self.league).config)

    def setting(self, *key: str, otherwise: R) -> R:
        """Return a setting, e.g. `setting("rating", "share", otherwise=0.1)`; `otherwise` if the text lacks it."""
        return self.settings().get(*key, otherwise=otherwise)

    def roles(self) -> Callable[[str], "Role"]:
        """Return a function from names to roles, defaults filled in. Raises ConfigError for invalid settings."""
        return self.settings().roles()


class Shown(NamedTuple):
    """Ladders of a league, and the data that their rows have beside results."""

    key: ArenaKey | None  # of the first; None if nothing was played
    ladders: list[Ladder]
    others: list[ArenaKey]  # of the ladders that are not shown
    snapshots: list[Snapshot]
    players: list[Player]
    void_limit: float

    @property
    def names(self) -> list[str]:
        """Names of the players, in the league's order: that of their colours."""
        return [player.name for player in self.players]


def only_league(store: Store) -> str:
    """Return the league of a store when none is named: the only one, otherwise the league that was run last."""
    leagues = store.leagues()
    if not leagues:
        raise NoLeague(f"{store.where} holds no league yet: `league run` makes one.")
    last_run = {league.name: max((run.id for run in store.runs(league.name)), default=0) for league in leagues}
    return max(leagues, key=lambda league: last_run[league.name]).name


def choose(keys: Sequence[ArenaKey], arena: str | None = None, engine: str | None = None) -> ArenaKey | None:
    """Return the first key that matches; None if nothing is requested and nothing was played.

    Raises StorageError, which lists the keys, if none matches.
    """
    fitting = [key for key in keys if arena in (None, key.arena) and engine in (None, key.engine)]
    if not fitting and (arena or engine):
        asked = " ".join(filter(None, (arena and f"in arena {arena!r}", engine and f"under engine {engine!r}")))
        there = ", ".join(dict.fromkeys(f"{key.arena} under {key.engine}" for key in keys)) or "none"
        raise StorageError(f"No rating match was played {asked}; there are: {there}.")
    return fitting[0] if fitting else None


def require_whole(snapshot: Snapshot, others: Iterable[Snapshot]) -> None:
    """Raise StorageError if a snapshot has been thinned; the message names snapshots of its player that can play."""
    if snapshot.thinned is None:
        return
    able = [s for s in others if s.player == snapshot.player and s.thinned is None]
    near = sorted(able, key=lambda s: abs(s.iteration - snapshot.iteration))[:2]
    instead = " or ".join(s.name for s in sorted(near, key=lambda s: s.iteration))
    raise StorageError(
        f"{snapshot.name} of league {snapshot.league} has been thinned: its matches count, but its policy is gone."
        f" Take {instead} instead."
    )


def match_frame(matches: Iterable[Match | RankedMatch]) -> "pd.DataFrame":
    """Return `match_rows` as a data frame, which has its columns without rows too."""
    import pandas as pd

    rows = match_rows(matches)
    return pd.DataFrame(rows, columns=None if rows else list(MATCH_COLUMNS))


def match_rows(matches: Iterable[Match | RankedMatch]) -> list[Row]:
    """See Open.matches. Training is not played by snapshots: `blue@32+` is blue some time after blue@32.

    Only where there are matches of three and more teams do rows have the columns of these.
    """
    given = list(matches)
    lineups = any(isinstance(m, RankedMatch) for m in given)
    return [
        {
            "match": m.id, **_result(m), **(_lineup(m) if lineups else {}), "void_causes": cause_names(m.causes),
            "seed": m.seed, "steps": m.steps, "purpose": m.purpose, "recorded": m.recording is not None,
            "recording": m.recording, **m.arena._asdict(), "created": m.created,
        }
        for m in given
    ]  # fmt: skip


def _result(m: Match | RankedMatch) -> Row:
    """Return the part of a row that is counted for A; nothing of a ranked match is."""
    if isinstance(m, RankedMatch):
        counts = dict.fromkeys(("a", "b", "wins", "draws", "losses"))
        return {**counts, "voids": m.voids, "voids_a": None, "voids_b": None, "score": None}
    return {
        "a": _called(m, m.a), "b": _called(m, m.b), "wins": m.wins, "draws": m.draws, "losses": m.losses,
        "voids": m.voids, "voids_a": m.voids_a, "voids_b": m.voids_b,
        "score": (m.wins + m.draws / 2) / m.episodes if m.episodes else None,
    }  # fmt: skip


def _lineup(m: Match | RankedMatch) -> Row:
    """Return the part of a row that only a ranked match fills: who played with whom, and how it ended."""
    if isinstance(m, Match):
        return dict.fromkeys(("lineup", "mean_ranks", "rankings", "voids_by_team"))
    means = [sum(ranks[i] * n for ranks, n in m.rankings.items()) for i in range(len(m.snapshots))]
    return {
        "lineup": ", ".join(str(_called(m, name)) for name in m.snapshots),
        "mean_ranks": ", ".join(f"{mean / m.episodes:.2f}" for mean in means) if m.episodes else None,
        "rankings": "; ".join(f"{','.join(map(str, ranks))}: {n}" for ranks, n in sorted(m.rankings.items())),
        "voids_by_team": ", ".join(map(str, m.voids_by_team)),
    }


def _called(match: Match | RankedMatch, name: str | None) -> str | None:
    return f"{name}+" if name and match.purpose == "training" else name


def snapshot_rows(snapshots: Iterable[Snapshot], ends: Mapping[str, str] = MappingProxyType({})) -> list[Row]:
    """See Open.snapshots; `ends` are the ends of the settings of snapshots that were read without them."""
    return [
        {
            "name": s.name, "player": s.player, "script": s.script, "origin": s.origin, "parent": s.parent,
            "initial": s.initial, "iteration": s.iteration, "steps": s.step, "seconds": round(s.seconds, 1),
            "roster": s.roster, "digest": s.digest, "arena": s.arena.arena if s.arena else None,
            "engine": s.arena.engine if s.arena else None, "created": s.created, "thinned": s.thinned,
            "code": code_of(ends.get(s.name, s.settings)),
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
    """Return a score with its 95 % interval, e.g. `97.3 % (95.8-98.4) of 512`, and void episodes if they are many."""
    void = f", {score.voids} more void" if score.suspect else ""
    return f"{100 * score.score:.1f} % ({100 * score.low:.1f}-{100 * score.high:.1f}) of {score.games}{void}"
