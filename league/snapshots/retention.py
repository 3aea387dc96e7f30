"""Choice of snapshots whose bytes may be removed. A dense history is thinned to one that gets sparser with a player's
age, in the same way as snapshots are made (`training.snapshots_per_doubling`).

A thinned snapshot stays on the ladder with all its results, and is not sampled as an opponent any more. In any case
`storage.maintenance.thinning` keeps each player's first and newest snapshot and those that a waiting job names.
"""

import math
import tomllib
from collections.abc import Iterable, Sequence

from league.config.durations import seconds
from league.config.sections import Rating
from league.queries.query import Open
from storage.database.rows import strings_in
from storage.records import Snapshot


def first_of_each_part(history: Sequence[Snapshot], per_doubling: int) -> set[str]:
    """Return the name of the first snapshot in each of `per_doubling` parts of every doubling of iterations.

    The parts are [2^(k/n), 2^((k+1)/n)), with n = `per_doubling`. They do not depend on later snapshots, so a snapshot
    that was kept once is always kept. `history` has a player's snapshots, oldest first.
    """
    found: dict[int, str] = {}
    for s in history:
        found.setdefault(math.floor(per_doubling * math.log2(max(s.iteration, 1)) + 1e-9), s.name)
    return set(found.values())


def may_go(opened: Open, per_doubling: int) -> set[str]:
    """Return the names of the snapshots whose bytes such a history does not need.

    The history keeps those of `spared`, snapshots that a person has named (in a gate, an exhibition or an attack, or in
    the league's settings), the first after each milestone of training, which measures progress, each player's newest,
    initial and, by every ladder, best one, and all snapshots of no player.
    """
    store, league = opened.store, opened.league
    snapshots = [s for s in store.snapshots(league, brief=True) if s.thinned is None]
    kept = set(strings_in(tomllib.loads(store.league(league).config)))
    for match in store.log(league, ("gate", "exploit", "exhibition")):
        kept.update(match.players)
    best = _best(opened)
    marks = [seconds(mark) for mark in opened.setting("rating", "milestones", otherwise=list(Rating().milestones))]
    for player in store.players(league):
        history = [s for s in snapshots if s.player == player.name]
        kept |= (
            first_of_each_part(history, per_doubling)
            | best
            | _first_after(history, marks)
            | {s.name for s in history[-1:]}
        )
    return {s.name for s in snapshots if s.player is not None and not s.initial} - kept


def _first_after(history: Sequence[Snapshot], marks: Iterable[float]) -> set[str]:
    late = [[s.name for s in history if s.seconds >= mark][:1] for mark in marks]
    return {name for names in late for name in names}


def _best(opened: Open) -> set[str]:
    """Return for each ladder each player's best snapshot, by the lower end of its interval."""
    found: set[str] = set()
    shown = opened.shown(all=True)
    for ladder in shown.ladders:
        best = dict[str, tuple[float, str]]()
        for s in shown.snapshots:
            if s.player is None or s.thinned is not None:
                continue
            if ladder.one_team:
                merit = ladder.success(s.name).low if ladder.trial_episodes(s.name) else -math.inf
            else:
                merit = float(ladder.ratings.low[ladder.payoff.index(s.name)]) if ladder.known(s.name) else -math.inf
            if merit > -math.inf:
                best[s.player] = max(best.get(s.player, (-math.inf, "")), (merit, s.name))
        found |= {name for _, name in best.values()}
    return found
