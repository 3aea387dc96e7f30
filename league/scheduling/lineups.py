"""Lineups of rating matches in arenas of three and more teams: a pair that is to meet, completed by other snapshots.

Pairs are chosen as in an arena of two teams, because a ranking of n teams counts as a game of every pair in it. The
seats that are left go to the newest snapshots of other players, so that every lineup has newest ones: the pairs of
newest snapshots give the lineup of the newest of all players, and a newest snapshot and its parent meet among the
others' newest.
"""

from collections.abc import Sequence

from league.scheduling.progress_metrics import newest_snapshots
from league.state.league_state import LeagueState
from matchmaking.match_design import others_after
from storage.records import Player, Snapshot

Lineup = tuple[str | None, ...]
"""Names of snapshots, one for each team; in an arena of one team a snapshot and None."""


def complete(pairs: Sequence[tuple[str, str]], state: LeagueState) -> list[Lineup]:
    """Return the lineups of these pairs, in their order; in an arena of two teams the pairs themselves.

    Pairs that give the same set of snapshots give one lineup, and a pair that nobody can complete gives none.
    """
    rosters = team_rosters(state.players)
    if len(rosters) < 3:
        return [*pairs]
    able = {s.name: s for s in state.snapshots if s.thinned is None}
    newest = [s.name for s in newest_snapshots(state) if s.name in able]
    rest = sorted(able.values(), key=lambda s: (s.script is not None, -s.iteration, s.name))
    found: dict[frozenset[str], tuple[str, ...]] = {}
    for pair in pairs:
        after = others_after(newest, pair[0]) if pair[0] in newest else newest
        lineup = _seated([able[name] for name in pair], [able[name] for name in after] + rest, rosters)
        if lineup is not None:
            found.setdefault(frozenset(lineup), lineup)
    return [*found.values()]


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
