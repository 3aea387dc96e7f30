"""Lineups of rating matches in arenas of three and more teams: a pair that is to meet, completed by other snapshots.

Pairs are chosen as in an arena of two teams, because a ranking of n teams counts as a game of every pair in it. With a
required pair (`matchmaking.match_design`) the newest snapshots of other players take the seats that are left: the pairs
of newest snapshots give the lineup of the newest of all players, and a newest snapshot and its parent meet among the
others' newest. With a pair of the pool those take them that have played least.
"""

from collections.abc import Sequence

from league.scheduling.progress_metrics import newest_snapshots
from league.state.jobs import RatingMatch, decode
from league.state.league_state import LeagueState
from matchmaking.match_design import others_after
from storage.records import Player, Snapshot

Lineup = tuple[str | None, ...]
"""Names of snapshots, one for each team; in an arena of one team a snapshot and None."""


def complete(pairs: Sequence[tuple[str, str]], state: LeagueState, quota: int | None = None) -> list[Lineup]:
    """Return the lineups of these pairs, in their order; in an arena of two teams the pairs themselves.

    Pairs that give the same set of snapshots give one lineup, and a pair that nobody can complete gives none. Pairs of
    the pool have a `quota`, the episodes as which a planned lineup counts; required pairs have none.
    """
    rosters = team_rosters(state.players)
    if len(rosters) < 3:
        return [*pairs]
    able = {s.name: s for s in state.snapshots if s.thinned is None}
    newest = [s.name for s in newest_snapshots(state) if s.name in able]
    rest = sorted(able.values(), key=lambda s: (s.script is not None, -s.iteration, s.name))
    payoff = state.ladder.payoff
    episodes = {} if quota is None else {name: int(payoff.total_episodes[payoff.index(name)]) for name in able}
    found: dict[frozenset[str], tuple[str, ...]] = {}
    for pair in pairs:
        if quota is None:
            after = others_after(newest, pair[0]) if pair[0] in newest else newest
            others = [able[name] for name in after] + rest
        else:
            others = sorted(rest, key=lambda s: episodes[s.name])
        lineup = _seated([able[name] for name in pair], others, rosters)
        if lineup is None:
            continue
        found.setdefault(frozenset(lineup), lineup)
        if quota is not None:
            episodes |= {name: episodes[name] + quota for name in lineup}
    return [*found.values()]


def failed_alone(state: LeagueState) -> set[Lineup]:
    """Return the lineups whose rating match was set aside although it was played alone: they are not played again."""
    tasks = [decode(job) for job in state.jobs if job.kind == RatingMatch.kind and job.state == "failed"]
    return {each.lineups[0] for each in tasks if isinstance(each, RatingMatch) and len(each.lineups) == 1}


def team_rosters(players: Sequence[Player]) -> list[str]:
    """Return the roster of each team, in their order."""
    by_team = {p.team: p.roster for p in players}
    return [by_team[team] for team in sorted(by_team)]


def _seated(pair: Sequence[Snapshot], others: Sequence[Snapshot], rosters: Sequence[str]) -> tuple[str, ...] | None:
    """Return a snapshot for each team: the pair at the first teams that they fit, then the first others that fit.

    None if there are not enough different snapshots of a roster.
    """
    seats: list[str | None] = [None] * len(rosters)
    for snapshot in (*pair, *others):
        free = [i for i, roster in enumerate(rosters) if seats[i] is None and roster == snapshot.roster]
        if free and snapshot.name not in seats:
            seats[free[0]] = snapshot.name
    whole = tuple(name for name in seats if name is not None)
    return whole if len(whole) == len(rosters) and {s.name for s in pair} <= set(whole) else None
