"""The players of a recorded match for a viewer: colour, role, and the rating before the match."""

from collections.abc import Sequence

from dashboards.identity import COLOURS, MatchPlayer, with_distinct_colours
from league.queries.query import Open, score_text
from league.queries.ratings.rating_rows import FIXED
from matchmaking.ratings.ladder import Ladder, Pool
from storage.records import RATED_PURPOSES, Match, RankedMatch, Snapshot


def players_of(opened: Open, match: Match | RankedMatch, sides: Sequence[str]) -> tuple[MatchPlayer, ...]:
    """Return the players of the sides, given as names of snapshots; one that the league no longer has gets only a name.

    Colours are numbered by the league's players, in the order in which they were made, and then by the other members
    of its pool, so a player has the same colour in every match of a league. A learner is shown as a player at an
    iteration.
    """
    snapshots = {s.name: s for s in opened.store.snapshots(opened.league, brief=True)}
    roles = {player.name: player.role for player in opened.store.players(opened.league)}
    others = sorted(name for name, s in snapshots.items() if s.player is None)
    numbers = {name: i for i, name in enumerate(dict.fromkeys((*roles, *others)))}
    ladder = before(opened, match)
    found, ages = [], []
    for side, name in enumerate(sides):
        snapshot, (player, _, iteration) = snapshots.get(name), name.rpartition("@")
        learns = match.purpose == "training" and player in roles and iteration.isdecimal()
        key = player if learns else (snapshot.player or name) if snapshot else ""
        number, role = numbers.get(key, side), roles[player] if learns else _role(snapshot, roles)
        rated = "" if learns else rating(ladder, name)
        found.append(MatchPlayer(name, COLOURS[number % len(COLOURS)], role, rated))
        ages.append(int(iteration) if learns else snapshot.iteration if snapshot else 0)
    return with_distinct_colours(found, ages)


def before(opened: Open, match: Match | RankedMatch) -> Ladder:
    """Return the ladder of a match's arena from before the match was filed."""
    store, league = opened.store, opened.league
    snapshots = [s for s in store.snapshots(league, brief=True) if s.created <= match.created]
    log = store.totals(league, RATED_PURPOSES, match.created - 1e-6).get(match.arena)
    return Ladder(Pool.of(snapshots, store.players(league)), log or ())


def rating(ladder: Ladder, name: str) -> str:
    """Return a rating as text, e.g. `1234 ± 56`; in an arena of one team a success rate; empty if it is unknown."""
    if name not in ladder.names:
        return ""
    if ladder.one_team:
        return score_text(ladder.success(name)) if ladder.trial_episodes(name) else ""
    if not ladder.known(name):
        return ""
    at, fit = ladder.payoff.index(name), ladder.ratings
    return f"{fit.elo[at]:.0f} ± {(fit.high[at] - fit.low[at]) / 2:.0f}"


def _role(snapshot: Snapshot | None, roles: dict[str, str]) -> str:
    if snapshot is None:
        return ""
    return roles.get(snapshot.player or "", FIXED)
