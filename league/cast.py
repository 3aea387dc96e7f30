"""Who plays in a recorded match, as a viewer shows it: colour, role, and the rating before the match."""

from collections.abc import Sequence

from dashboards.cast import COLOURS, Performer, told_apart
from league.query import Open, score_text
from league.rated import FIXED
from matchmaking.ladder import Ladder, Pool
from storage.records import RATED, Match, Snapshot


def cast(opened: Open, match: Match, sides: Sequence[str]) -> tuple[Performer, ...]:
    """The performers of the sides, snapshots by name; one that the league no longer has is shown by its name alone.

    Colours are numbered by the league's players, in the order in which they were made, and then by what else is in its
    pool, so in every match of a league a player has the same one. Who learns is a player at an iteration.
    """
    snapshots = {s.name: s for s in opened.store.snapshots(opened.league)}
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
        found.append(Performer(name, COLOURS[number % len(COLOURS)], role, rated))
        ages.append(int(iteration) if learns else snapshot.iteration if snapshot else 0)
    return told_apart(found, ages)


def before(opened: Open, match: Match) -> Ladder:
    """The ladder of a match's arena as it stood before that match was filed."""
    store, league = opened.store, opened.league
    snapshots = [s for s in store.snapshots(league) if s.created <= match.created]
    log = store.totals(league, RATED, match.created - 1e-6).get(match.arena)
    return Ladder(Pool.of(snapshots, store.players(league)), log or ())


def rating(ladder: Ladder, name: str) -> str:
    """A rating as text, e.g. `1234 ± 56`, a success rate in an arena of one team; nothing where it is not known."""
    if name not in ladder.names:
        return ""
    if ladder.one_team:
        return score_text(ladder.success(name)) if ladder.tried(name) else ""
    if not ladder.known(name):
        return ""
    at, fit = ladder.payoff.index(name), ladder.ratings
    return f"{fit.elo[at]:.0f} ± {(fit.high[at] - fit.low[at]) / 2:.0f}"


def _role(snapshot: Snapshot | None, roles: dict[str, str]) -> str:
    if snapshot is None:
        return ""
    return roles.get(snapshot.player or "", FIXED)
