"""Cross-play: the newest snapshots of several leagues on one ladder, by matches between them.

The matches are rating matches of a league of their own, `cross-play.HASH`, in the first league's store: it holds a copy
of each snapshot under the name LEAGUE.SNAPSHOT. Nothing of the compared leagues changes, what was played is not played
again, and every command can show that league. Elo counts from the mean of the snapshots that are compared: a distance
to untrained policies would widen every interval.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from league.config import experiment
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.matches.evaluator import MatchEvaluator
from league.matches.store_rating import Done, Limits, rate
from league.queries.query import Open
from league.queries.ratings.rating_rows import Row, rating_rows
from league.runs.comparison.cells import CROSS_PLAY, Member, holds_copies
from league.system.arena_build import build, rating_batch
from matchmaking.ratings.ladder import Ladder, Pool
from storage.records import RATED_PURPOSES, ArenaKey, League, Match, Player, RankedMatch, Snapshot
from storage.store import Store

DIGITS = 8  # of the digest of the arena's settings


@dataclass(frozen=True)
class Entry:
    """A snapshot of a comparison."""

    member: Member
    original: Snapshot
    copy: Snapshot
    player: Player  # the copy's
    role: str  # of the original's player


class CrossPlay:
    """The cross-play of several leagues. Raises ConfigError, one line, if they cannot meet."""

    def __init__(self, found: Sequence[Member], store: Store, into: str | None = None):
        first = found[0].opened
        config = experiment.loads(first.store.league(first.league).config)
        config = replace(config, rating=replace(config.rating, record=False))
        players = first.store.players(first.league)
        self.arena = build(config, rating_batch(config).worlds, players)
        self.league = into or f"{CROSS_PLAY}.{self.arena.config_hash[:DIGITS]}"
        self._store, self._config = store, replace(config.afresh, league=self.league, stages=())
        self.left_out = [member.name for member in found if not _newest(member)]
        self.entries = [entry for member in found for entry in self._entries(member)]
        if len(self.entries) < 2:
            raise ConfigError((), f"fewer than two snapshots to compare: {', '.join(m.name for m in found)}")
        self._refuse_strangers(players)

    @property
    def elsewhere(self) -> list[str]:
        """Leagues that learnt under other rules, rewards or physics than those of the matches."""
        key = self.arena.config_hash
        names = [e.member.name for e in self.entries if e.original.arena and e.original.arena.config_hash != key]
        return list(dict.fromkeys(names))

    def play(self, seconds: float, episodes: int | None = None, width: float | None = None) -> Iterator[Done]:
        """Play until a limit is reached; yield the state before the first batch and after each."""
        self._file()
        config: Config = self._config
        evaluator = MatchEvaluator(config, self.arena, self.league)
        opened, copies = Open(self._store, self.league), [entry.copy for entry in self.entries]
        yield from rate(opened, config, evaluator, copies, Limits(seconds, episodes, width))

    def ladder(self) -> Ladder:
        """Return the ladder of the compared snapshots, from all matches that they have played in this arena."""
        pool = Pool.of([entry.copy for entry in self.entries], [entry.player for entry in self.entries])
        return Ladder(pool, [m for m in self._log() if m.arena == self._key])

    @property
    def uncounted(self) -> dict[ArenaKey, int]:
        """Episodes of the compared snapshots under other keys, whose scores are not comparable with the ladder's."""
        found = Counter[ArenaKey]()
        for match in self._log():
            found[match.arena] += match.episodes
        return {key: number for key, number in found.items() if key != self._key}

    @property
    def _key(self) -> ArenaKey:
        return ArenaKey(self.arena.name, self.arena.config_hash, self.arena.engine.name)

    def _log(self) -> list[Match | RankedMatch]:
        """Return the matches of the compared snapshots, under all keys."""
        names = {entry.copy.name for entry in self.entries}
        there = self.league in {league.name for league in self._store.leagues()}
        log = self._store.log(self.league, RATED_PURPOSES) if there else []
        return [match for match in log if names.issuperset(match.players)]

    def rows(self, ladder: Ladder) -> list[Row]:
        """Return the rows of the ladder, best first, each with its league and the role that its player has there."""
        of = {entry.copy.name: entry for entry in self.entries}
        copies, players = [e.copy for e in self.entries], [e.player for e in self.entries]
        rows = rating_rows(ladder, copies, players)
        return [{**row, "league": of[row["name"]].member.name, "role": of[row["name"]].role} for row in rows]

    def _entries(self, member: Member) -> Iterator[Entry]:
        players = {p.name: p for p in member.opened.store.players(member.opened.league)}
        prefix = member.opened.league if "#" not in member.name else member.name.replace("#", ".").replace("/", "-")
        for snapshot in _newest(member):
            own = players[str(snapshot.player)]
            player = replace(
                own, league=self.league, name=f"{prefix}.{own.name}", group=prefix, role="fixed", paused=None
            )
            copy = replace(
                snapshot, league=self.league, name=f"{prefix}.{snapshot.name}", player=player.name, parent=None,
                initial=False, settings="",
            )  # fmt: skip
            yield Entry(member, snapshot, copy, player, own.role)

    def _refuse_strangers(self, players: Sequence[Player]) -> None:
        rosters = {p.roster for p in players}
        for entry in self.entries:
            if entry.original.roster not in rosters:
                raise ConfigError(
                    (), f"league {entry.member.name} cannot meet the others in {self.arena.name}: its"
                    f" {entry.original.name} is of {entry.original.roster}, not of {' or '.join(sorted(rosters))};"
                    " --no-play compares the curves alone",
                )  # fmt: skip

    def _file(self) -> None:
        """Write the league of the matches, its players and copies of the snapshots; what is there already stays."""
        for entry in self.entries:
            source = entry.member.opened.store
            if source.where != self._store.where and not self._store.blobs.has(entry.copy.digest):
                self._store.blobs.put(source.blobs.get(entry.copy.digest))
        self._store.create_league(League(self.league, experiment.dumps(self._config)))
        self._store.add_players([entry.player for entry in self.entries])
        self._store.add_snapshots([entry.copy for entry in self.entries])


def require_own(store: Store, into: str | None) -> None:
    """Raise ConfigError if the league for the matches has other players, whose ratings the matches would change."""
    if into is not None and store.players(into) and not holds_copies(store, into):
        raise ConfigError(
            ("into",), f"--into {into} is a league with players of its own, whose ratings these matches would change:"
            " give a new name, or that of a league that --into made",
        )  # fmt: skip


def _newest(member: Member) -> list[Snapshot]:
    """Return the newest snapshot of each player that has learnt and can still play."""
    opened = member.opened
    found: dict[str, Snapshot] = {}
    for snapshot in opened.store.snapshots(opened.league, brief=True):
        if snapshot.player and snapshot.thinned is None and snapshot.iteration:
            found[snapshot.player] = snapshot
    return list(found.values())
