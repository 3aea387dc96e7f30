"""Choice of a recorded match: by its number, the newest, between the best players, or the greatest upset."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

from league.queries.query import Open
from matchmaking.ratings.ladder import Ladder
from storage.errors import DamagedBlob, StorageError, Unavailable, UnknownName
from storage.recordings.recording import Recording, RecordingError, RecordingHeader, from_bytes, headers
from storage.recordings.salvage import salvage
from storage.records import Match, RankedMatch

AnyMatch = Match | RankedMatch
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


def chosen(opened: Open, query: RecordingQuery) -> AnyMatch:
    """Return the requested match. Raises StorageError, one line, if there is none of that kind."""
    if query.match is not None:
        return _numbered(opened, query.match)
    found = _among(opened, recorded(opened), query)
    if not (query.upset or query.best or query.closest):
        return found[-1] if query.between else _newest(opened, found)
    found = _of_snapshots(found)
    if not found:
        raise StorageError("Nothing but training was recorded here: `league play` records a match of snapshots.")
    if query.closest:
        return _closest(found)
    return _upset(opened, found) if query.upset else _best(opened, found)


def recorded(opened: Open) -> list[AnyMatch]:
    """Return all recorded matches, oldest first. Raises StorageError if there is none."""
    found = [m for m in opened.store.log(opened.league) if m.recording is not None]
    if not found:
        raise StorageError(f"League {opened.league} has no recorded match yet: `league run` plays and records some.")
    return found


def following(opened: Open, poll: float = 1.0) -> Iterator[AnyMatch]:
    """Yield the newest recorded match, then each as it is filed, without end. Waits while the store is away."""
    last: int | None = None
    while True:
        with suppress(Unavailable):
            new = [m for m in opened.store.log(opened.league, after=last or 0) if m.recording is not None]
            for match in new if last is not None else new[-1:]:
                last = match.id
                yield match
            last = last or 0
        time.sleep(poll)


def load(opened: Open, match: AnyMatch, episode: int = 0, recover: bool = False) -> tuple[Recording, str]:
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


def _numbered(opened: Open, number: int) -> AnyMatch:
    matches = opened.store.log(opened.league)
    found = next((m for m in matches if m.id == number), None)
    if found is not None and found.recording is not None:
        return found
    near = sorted(sorted(m.id for m in matches if m.recording is not None), key=lambda id: abs(id - number))[:NEAR]
    there = ", ".join(map(str, sorted(near)))
    what = f"Match {number} was not recorded"
    if found is None:
        what = f"There is no match {number} in league {opened.league}"
    raise StorageError(f"{what}; recorded near it: {there or 'none'}. `league matches` lists all.")


def _among(opened: Open, matches: list[AnyMatch], query: RecordingQuery) -> list[AnyMatch]:
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


def _of_snapshots(matches: Sequence[AnyMatch]) -> list[AnyMatch]:
    """Return the matches between snapshots. In training matches, names of snapshots only stand for later policies."""
    return [m for m in matches if m.purpose != "training"]


def _newest(opened: Open, matches: Sequence[AnyMatch]) -> AnyMatch:
    """Return the newest match between two snapshots of players, the later the older one was frozen; else any newest.

    The newest match of all is often one against a script or an old snapshot, which shows little of what was learnt.
    """
    frozen = {s.name: s.iteration for s in opened.store.snapshots(opened.league, brief=True) if s.player}
    known = [m for m in matches if frozen.keys() >= set(m.players)]
    return max(known, key=lambda m: (min(frozen[side] for side in m.players), m.id)) if known else matches[-1]


def _closest(matches: Sequence[AnyMatch]) -> Match:
    """Return the match between two snapshots whose score was nearest to one half, the newest of equals."""
    rivals = [m for m in matches if isinstance(m, Match) and m.b is not None and m.episodes]
    if not rivals:
        raise StorageError("No recorded match here has two sides, so none was close.")
    return min(rivals, key=lambda m: (abs(m.wins - m.losses) / m.episodes, -m.id))


def _best(opened: Open, matches: Sequence[AnyMatch]) -> AnyMatch:
    """Return the match whose weaker side has the best present rating, the newest of equals, in the newest arena."""
    key = matches[-1].arena  # Elo of two ladders cannot be compared
    ladder = opened.ladder(key)
    strength, learnt = (
        _strength(ladder),
        {s.name for s in opened.store.snapshots(opened.league, brief=True) if s.player},
    )

    def interest(match: AnyMatch) -> tuple[bool, float, int]:
        return learnt.issuperset(match.players), min(map(strength, match.players)), match.id

    return max((m for m in matches if m.arena == key), key=interest)


def _upset(opened: Open, matches: Sequence[AnyMatch]) -> Match:
    """Return the recorded match with the winner rated furthest below the loser, by the ratings known now."""
    key = matches[-1].arena
    ladder = opened.ladder(key)
    strength = _strength(ladder)

    def gap(match: Match) -> float:
        return abs(strength(match.a) - strength(str(match.b)))

    pairs = [m for m in matches if isinstance(m, Match) and m.b is not None and m.arena == key]
    rivals = [m for m in pairs if all(map(ladder.known, m.players))]
    for match in sorted(rivals, key=gap, reverse=True):
        weaker_wins = match.wins if strength(match.a) < strength(str(match.b)) else match.losses
        if weaker_wins and gap(match) > 0:
            first = headers(opened.store.blobs.get(str(match.recording)))[0]
            if _won(first) == min(match.players, key=strength):
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
