"""Choice of a recorded match: by its number, the newest, between the best players, or the greatest upset."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache

from league.queries.query import Open
from league.state.match_results import results_of
from matchmaking.ratings.ladder import Ladder
from storage.errors import DamagedBlob, StorageError, Unavailable, UnknownName
from storage.recordings.recording import Recording, RecordingError, RecordingHeader, from_bytes, headers
from storage.recordings.salvage import salvage
from storage.records import ArenaKey, Match, RankedMatch

Rated = Callable[[ArenaKey], Ladder]
"""Function from a key to its ladder."""
NEWEST = 10_000
"""Number of recorded matches among which a page chooses: an old league has as many as its log has rows."""
NEAR = 5  # most numbers of other matches in the message about an unknown match


@dataclass(frozen=True)
class RecordingQuery:
    """Request for a match; without any values, the newest match of the players' newest snapshots on record."""

    match: int | None = None
    best: bool = False
    upset: bool = False
    closest: bool = False
    between: tuple[str, ...] = ()
    player: str | None = None

    @property
    def clashing(self) -> tuple[str, ...]:
        """The names of the requests that are made, if they ask for different matches; else empty."""
        one = [name for name in ("match", "best", "upset", "closest") if getattr(self, name) not in (None, False)]
        narrower = [name for name in ("between", "player") if getattr(self, name)]
        return (*one, *narrower) if len(one) > 1 or (self.match is not None and narrower) else ()


HIGHLIGHTS = {
    "newest": RecordingQuery(), "best-rated": RecordingQuery(best=True), "closest": RecordingQuery(closest=True),
    "greatest upset": RecordingQuery(upset=True),
}  # fmt: skip
"""Kinds of matches that a page shows, in this order."""


def chosen(opened: Open, query: RecordingQuery) -> Match | RankedMatch:
    """Return the requested match. Raises StorageError, one line, if there is none of that kind."""
    if query.match is not None:
        return _numbered(opened, query.match)
    return _select(opened, recorded(opened), query, opened.ladder)


def highlights(opened: Open, most: int, ladder: Ladder | None = None) -> list[tuple[str, Match | RankedMatch]]:
    """Return up to `most` recorded matches, none twice, each with its kind of HIGHLIGHTS; the newest comes first.

    They are chosen among the `NEWEST` recorded ones. `ladder` saves reading if the caller has the newest already.
    Raises StorageError if there is none.
    """
    matches, found = recorded(opened, NEWEST), dict[int, tuple[str, Match | RankedMatch]]()
    rated = cache(lambda key: ladder if ladder is not None and ladder.arena == key else opened.ladder(key))
    for kind, query in HIGHLIGHTS.items():
        if len(found) >= most:
            break
        with suppress(StorageError):  # none of that kind
            match = _select(opened, matches, query, rated)
            found.setdefault(match.id, (kind, match))
    return list(found.values())


def _select(
    opened: Open, matches: list[Match | RankedMatch], query: RecordingQuery, rated: Rated
) -> Match | RankedMatch:
    found = _among(opened, matches, query)
    if not (query.upset or query.best or query.closest):
        return found[-1] if query.between else _newest(opened, found)
    found = _of_snapshots(found)
    if not found:
        raise StorageError("Nothing but training was recorded here: `league play` records a match of snapshots.")
    if query.closest:
        return _closest(found)
    return _upset(opened, found, rated) if query.upset else _best(opened, found, rated)


def recorded(opened: Open, newest: int | None = None) -> list[Match | RankedMatch]:
    """Return all recorded matches, or so many of the newest, oldest first. Raises StorageError if there is none."""
    found = opened.store.log(opened.league, recorded=True, newest=newest)
    if not found:
        raise StorageError(
            f"League {opened.league} has no recorded match yet: `league run` plays and records some, except in games"
            " without bodies."
        )
    return found


def following(opened: Open, poll: float = 1.0) -> Iterator[Match | RankedMatch]:
    """Yield the newest recorded match, then each as it is filed, without end. Waits while the store is away."""
    last: int | None = None
    while True:
        with suppress(Unavailable):
            new = opened.store.log(opened.league, after=last or 0, recorded=True, newest=1 if last is None else None)
            for match in new:
                last = match.id
                yield match
            last = last or 0
        time.sleep(poll)


def load(opened: Open, match: Match | RankedMatch, episode: int = 0, recover: bool = False) -> tuple[Recording, str]:
    """Load one recorded episode of a match, and a description of what is missing.

    With `recover`, the readable part of a damaged recording is loaded, and the text describes the missing part.
    Raises StorageError, one line, if the recording is missing or damaged, or has no such episode.
    """
    try:
        data = opened.store.blobs.get(str(match.recording))
        count = len(headers(data))
        if not 0 <= episode < count:
            raise RecordingError(f"Match {match.id} has {count} recorded, from 0 on; there is no episode {episode}.")
        return from_bytes(data, episode), ""
    except DamagedBlob as error:
        if error.data is None:
            raise
        if not recover:
            raise StorageError(f"{error}; --recover shows what is whole of it") from error
        return salvage(error.data, episode)


def describe_match(match: Match | RankedMatch, recording: Recording) -> str:
    """Describe a match in a line."""
    header = recording.header
    what = "Training" if match.purpose == "training" else "Match"
    return f"{what} {match.id}: {' against '.join(header.sides)}, {header.outcome}, {recording.time[-1]:.1f} s"


def _numbered(opened: Open, number: int) -> Match | RankedMatch:
    found = next(iter(opened.store.log(opened.league, number=number)), None)
    if found is not None and found.recording is not None:
        return found
    there = [m.id for m in opened.store.log(opened.league, recorded=True)]
    near = sorted(there, key=lambda id: abs(id - number))[:NEAR]
    listed = ", ".join(map(str, sorted(near)))
    what = f"Match {number} was not recorded"
    if found is None:
        what = f"There is no match {number} in league {opened.league}"
    raise StorageError(f"{what}; recorded near it: {listed or 'none'}. `league matches` lists all.")


def _among(opened: Open, matches: list[Match | RankedMatch], query: RecordingQuery) -> list[Match | RankedMatch]:
    """Return the recorded matches of the named players or snapshots."""
    snapshots = {s.name: s for s in opened.store.snapshots(opened.league, brief=True)}
    for name in query.between:
        if name not in snapshots:
            raise UnknownName("snapshot", name, snapshots)
    players = {s.player for s in snapshots.values() if s.player}
    if query.player is not None and query.player not in players:
        raise UnknownName("player", query.player, players)
    matches = _of_snapshots(matches) if query.between else matches
    of = {name: snapshot.player for name, snapshot in snapshots.items()}
    between = Counter(query.between)
    found = [
        m for m in matches
        if between <= Counter(m.players) and (query.player is None or query.player in map(of.get, m.players))
    ]  # fmt: skip
    if not found:
        who = " and ".join(query.between) or query.player
        raise StorageError(f"No match of {who} was recorded: `league matches` tells which were.")
    return found


def _of_snapshots(matches: Sequence[Match | RankedMatch]) -> list[Match | RankedMatch]:
    """Return the matches between snapshots. In training matches, names of snapshots only stand for later policies."""
    return [m for m in matches if m.purpose != "training"]


def _newest(opened: Open, matches: Sequence[Match | RankedMatch]) -> Match | RankedMatch:
    """Return the newest match between snapshots of players, the later the older one was frozen; else any newest.

    The newest match of all is often one against a script or an old snapshot, which shows little of what was learnt.
    """
    frozen = {s.name: s.iteration for s in opened.store.snapshots(opened.league, brief=True) if s.player}
    known = [m for m in matches if frozen.keys() >= set(m.players)]
    return max(known, key=lambda m: (min(frozen[side] for side in m.players), m.id)) if known else matches[-1]


def _closest(matches: Sequence[Match | RankedMatch]) -> Match:
    """Return the match between two snapshots whose score was nearest to one half, the newest of equals."""
    rivals = [m for m in matches if isinstance(m, Match) and m.b is not None and m.episodes]
    if not rivals:
        raise StorageError("No recorded match here has two sides, so none was close.")
    return min(rivals, key=lambda m: (abs(m.wins - m.losses) / m.episodes, -m.id))


def _best(opened: Open, matches: Sequence[Match | RankedMatch], rated: Rated) -> Match | RankedMatch:
    """Return the match whose weaker side has the best present rating, the newest of equals, in the newest arena."""
    key = matches[-1].arena  # Elo of two ladders cannot be compared
    ladder = rated(key)
    strength, learnt = (
        _strength(ladder),
        {s.name for s in opened.store.snapshots(opened.league, brief=True) if s.player},
    )

    def interest(match: Match | RankedMatch) -> tuple[bool, float, int]:
        return learnt.issuperset(match.players), min(map(strength, match.players)), match.id

    return max((m for m in matches if m.arena == key), key=interest)


def _upset(opened: Open, matches: Sequence[Match | RankedMatch], rated: Rated) -> Match | RankedMatch:
    """Return the recorded match whose winner was rated furthest below another, by the ratings known now."""
    key = matches[-1].arena
    ladder = rated(key)
    strength = _strength(ladder)

    def gap(match: Match | RankedMatch) -> float:
        rated = [strength(name) for name in match.players]
        return max(rated) - min(rated)

    rivals = [m for m in matches if m.arena == key and len(m.players) > 1 and all(map(ladder.known, m.players))]
    for match in sorted(rivals, key=gap, reverse=True):
        weakest = min(match.players, key=strength)
        if results_of(match, weakest)[0] and gap(match) > 0:
            first = headers(opened.store.blobs.get(str(match.recording)))[0]
            if _won(first) == weakest:
                return match
    raise StorageError(f"In no recorded match of league {opened.league} the weaker side won, as far as they are rated.")


def _won(header: RecordingHeader) -> str | None:
    """Return the winner of the recorded episode; None after a draw or if physics failed."""
    first = max(range(len(header.score)), key=header.score.__getitem__)
    even = header.outcome == "void" or header.score.count(header.score[first]) > 1
    return None if even else header.sides[first]


def _strength(ladder: Ladder) -> Callable[[str], float]:
    if ladder.one_team:
        return lambda name: ladder.success(name).score
    return lambda name: float(ladder.ratings.strength[ladder.ratings.index(name)])
