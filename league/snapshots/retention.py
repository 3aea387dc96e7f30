"""Choice of snapshots whose bytes may be removed. A dense history is thinned to one that gets sparser with a player's
age, in the same way as snapshots are made (`training.snapshots_per_doubling`).

A thinned snapshot stays on the ladder with all its results, and is not sampled as an opponent any more. In any case
`storage.maintenance.thinning` keeps each player's first and newest snapshot and those that a waiting job names.
"""

import math
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import replace

from league.config.durations import seconds
from league.config.sections import Rating
from league.queries.query import Open
from league.scheduling.training_progress import best as best_rated
from league.scheduling.training_progress import rated
from league.state.league_state import LeagueState
from storage.database.rows import strings_in
from storage.errors import StorageError
from storage.records import League, Snapshot


def first_of_each_part(history: Sequence[Snapshot], per_doubling: int) -> set[str]:
    """Return the name of the first snapshot in each of `per_doubling` parts of every doubling of iterations.

    The parts are [2^(k/n), 2^((k+1)/n)), with n = `per_doubling`. They do not depend on later snapshots, so a snapshot
    that was kept once is always kept. `history` has a player's snapshots, oldest first.
    """
    found: dict[int, str] = {}
    for s in history:
        found.setdefault(math.floor(per_doubling * math.log2(max(s.iteration, 1)) + 1e-9), s.name)
    return set(found.values())


def may_go(opened: Open, per_doubling: int, leagues: Sequence[League] | None = None) -> set[str]:
    """Return the names of the snapshots whose bytes such a history does not need.

    The history keeps those of `first_of_each_part`, snapshots that a person has named (in a gate, an exhibition or an
    attack, in the league's settings, or in those of another league that goes on from it), the first after each
    milestone of training, which measures progress, each player's newest, initial and, by every ladder, best ones, and
    all snapshots of no player.

    `leagues` are those of the store, by default read from it. Raises StorageError where settings are damaged.
    """
    store, league = opened.store, opened.league
    snapshots = [s for s in store.snapshots(league, brief=True) if s.thinned is None]
    kept = _named(league, store.leagues() if leagues is None else leagues)
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


def _named(league: str, leagues: Iterable[League]) -> set[str]:
    """Return what a league's settings name, and what those of all leagues name as LEAGUE/SNAPSHOT of this league."""
    found: set[str] = set()
    for each in leagues:
        if each.name != league and f"{league}/" not in each.config:
            continue  # a store may have a thousand leagues, each of which is asked for the names of all others
        try:
            words = set(strings_in(tomllib.loads(each.config)))
        except (ValueError, RecursionError) as error:
            raise StorageError(
                f"The settings of league {each.name!r} are damaged, so nothing is removed: {str(error)[:100]}."
            ) from None
        found |= {word.removeprefix(f"{league}/") for word in words if word.startswith(f"{league}/")}
        found |= words if each.name == league else set()
    return found


def _best(opened: Open) -> set[str]:
    """Return for each ladder each player's best snapshots: by the lower end of its rating's interval, and by that of
    the score by which a league that goes on from the player chooses (`training_progress.handed_on`).
    """
    found: set[str] = set()
    shown = opened.shown(all=True)
    state = LeagueState(shown.players, shown.snapshots, jobs=opened.store.jobs(opened.league, "failed"))
    quota = opened.setting("rating", "episodes_per_pair", otherwise=Rating().episodes_per_pair)
    against = opened.setting("budget", "against", otherwise=[])
    for ladder in shown.ladders:
        for player in shown.players:
            scored = rated(replace(state, ladder=ladder), player.name, quota, against)
            top = best_rated([each for each in scored if each.snapshot.thinned is None])
            found |= {top.snapshot.name} if top is not None else set()
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
