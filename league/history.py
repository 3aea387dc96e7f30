"""Which snapshots of a league may give up their bytes: a history that was frozen densely is thinned to one that gets
sparser with a player's age, as snapshots are frozen anyway (`training.snapshots_per_doubling`).

What is thinned stays on the ladder with all it has played, and is drawn by nobody. `storage.thinning` spares, whatever
is said here, each player's first and newest and what a waiting job names.
"""

import math
import tomllib
from collections.abc import Iterable, Sequence

from league.config.durations import seconds
from league.config.sections import Rating
from league.query import Open
from storage.records import Snapshot
from storage.rows import texts


def spared(history: Sequence[Snapshot], per_doubling: int) -> set[str]:
    """Of a player's snapshots, oldest first, the first in each of `per_doubling` parts of every doubling of iterations.

    The parts are [2^(k/n), 2^((k+1)/n)), whatever comes later: what was spared once is spared ever after.
    """
    found: dict[int, str] = {}
    for s in history:
        found.setdefault(math.floor(per_doubling * math.log2(max(s.iteration, 1)) + 1e-9), s.name)
    return set(found.values())


def may_go(opened: Open, per_doubling: int) -> set[str]:
    """The names of the snapshots whose bytes nobody needs in such a history.

    Besides those of `spared` there stay: who was named by a person (in a gate, an exhibition or an attack, or in the
    league's settings), the first after each milestone of training, by which progress is told, each player's best by
    every ladder, and all that is of no player.
    """
    store, league = opened.store, opened.league
    snapshots = [s for s in store.snapshots(league) if s.thinned is None]
    kept = set(texts(tomllib.loads(store.league(league).config)))
    for match in store.matches(league, ("gate", "exploit", "exhibition")):
        kept |= {match.a, match.b or ""}
    best = _best(opened)
    marks = [seconds(mark) for mark in opened.setting("rating", "milestones", otherwise=list(Rating().milestones))]
    for player in store.players(league):
        history = [s for s in snapshots if s.player == player.name]
        kept |= spared(history, per_doubling) | best | _first_after(history, marks) | {s.name for s in history[-1:]}
    return {s.name for s in snapshots if s.player is not None and not s.initial} - kept


def _first_after(history: Sequence[Snapshot], marks: Iterable[float]) -> set[str]:
    late = [[s.name for s in history if s.seconds >= mark][:1] for mark in marks]
    return {name for names in late for name in names}


def _best(opened: Open) -> set[str]:
    """Each player's snapshot of the highest Elo that is known, on every ladder; in an arena of one team, of success."""
    found: set[str] = set()
    snapshots = opened.store.snapshots(opened.league)
    for key in opened.ladders():
        ladder, best = opened.ladder(key), dict[str, tuple[float, str]]()
        for s in snapshots:
            if s.player is None or s.thinned is not None:
                continue
            if ladder.one_team:
                merit = ladder.success(s.name).score if ladder.tried(s.name) else -math.inf
            else:
                merit = float(ladder.ratings.elo[ladder.payoff.index(s.name)]) if ladder.known(s.name) else -math.inf
            if merit > -math.inf:
                best[s.player] = max(best.get(s.player, (-math.inf, "")), (merit, s.name))
        found |= {name for _, name in best.values()}
    return found
