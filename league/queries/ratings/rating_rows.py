"""Rows of a ladder, one per snapshot, as `league ratings` prints and `league.open(...).ratings()` gives them."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, date, datetime
from typing import Any

import numpy as np

from league.scheduling.progress_metrics import initial_opponents
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.payoff import Payoff
from matchmaking.ratings.scores import Score, is_suspect
from storage.errors import UnknownName
from storage.records import ArenaKey, Player, Snapshot

Row = dict[str, Any]
VOID_LIMIT = 0.02
"""Share above which void episodes are suspect, if a league's settings do not give it (`rating.void_limit`)."""
VOID_MARK = "v"
VOID_NOTE = f"{VOID_MARK}: more episodes were void than a tenth of the games, so these games are a selection."
"""The mark of a suspect score (see matchmaking.ratings.scores.Score) and its meaning."""
FEW = 3
"""Number of opponents below which a rating is provisional: it may reflect a match-up with these few opponents."""
FIXED = "fixed"
"""The role of scripts and imported policies, which belong to no player and never learn."""


def rating_rows(
    ladder: Ladder, snapshots: Sequence[Snapshot], players: Sequence[Player], void_limit: float = VOID_LIMIT
) -> list[Row]:
    """See Open.ratings. Snapshots with an unknown rating come after the others; those that never played come last.

    Groups of snapshots that no games connect (islands) are ranked one after the other, the largest first.
    """
    ratings, payoff, one_team = ladder.ratings, ladder.payoff, ladder.one_team
    elo, lows, highs = (each.tolist() for each in (ratings.elo, ratings.low, ratings.high))
    roles = {p.name: p.role for p in players}
    void = payoff.total_episodes - payoff.played + payoff.trials[:, 2]
    counts = np.column_stack([payoff.results, void]).tolist()
    initial, opponents = scores_against_initial(ladder, snapshots, players), opponents_met(payoff)
    found = ladder.separation
    rows = []
    for s in snapshots:
        i = payoff.index(s.name)
        wins, draws, losses, void = counts[i]
        success = ladder.success(s.name) if one_team else None
        if success:
            wins, losses = payoff.trials[i, :2].tolist()
        games, voids = wins + draws + losses, ladder.void_rate(s.name)
        met, tried = bool(games) and not success, success if success and games else None
        against = initial.get(s.name)
        rows.append({
            "rank": None, "player": s.player, "name": s.name, "role": roles.get(s.player or "", FIXED),
            "elo": elo[i] if met else None,
            "low": lows[i] if met else None,
            "high": highs[i] if met else None, "known": ladder.known(s.name) and not found.unknown[i],
            "opponents": opponents[i], "provisional": met and opponents[i] < FEW,
            "games": games, "wins": wins, "draws": draws, "losses": losses,
            "voids": void,
            "win_rate": (wins + draws / 2) / games if met else None,
            "suspect": is_suspect(games, void),
            "vs_initial_suspect": against.suspect if against else None,
            "vs_initial": against.score if against else None,
            "vs_initial_low": against.low if against else None,
            "vs_initial_high": against.high if against else None,
            "success": tried.score if tried else None,
            "success_low": tried.low if tried else None, "success_high": tried.high if tried else None,
            "last_played": when(payoff.last[i]),
            "iteration": s.iteration if s.player else None, "seconds": round(s.seconds, 1) if s.player else None,
            "voids_own": voids.own, "voids_unclear": voids.unclear,
            "flagged": "!" if voids.own > void_limit else "?" if voids.suspect > void_limit else "",
            "tilt": float(ratings.population_offsets[ratings.population[i]]) if ladder.pool.populations else 0.0,
            "island": int(found.island[i]) or None, "unbounded": found.ratings[i],
            "digest": s.digest, "roster": s.roster,
            **(ladder.arena or ArenaKey("", "", ""))._asdict(),
        })  # fmt: skip
    return _ranked(rows, "success_low" if one_team else "low", one_team, bool(ladder.pool.populations))


def opponents_met(payoff: Payoff) -> list[int]:
    """(P,) Number of opponents that each snapshot has met in valid games."""
    met = (payoff.home.sum(1) + payoff.away.sum(1)) > 0
    ends = np.concatenate([payoff.first[met], payoff.second[met]])
    return np.bincount(ends, minlength=len(payoff.names)).tolist()


def _ranked(rows: list[Row], merit: str, one_team: bool, by_side: bool) -> list[Row]:
    """Return the rows, best first by the lower end of the interval, with ranks for known ratings per island and side.

    A high rating from few games therefore ranks below a slightly lower rating from many games. Sides have ranks of
    their own if they are unlike.
    """

    def place(row: Row) -> tuple:
        unsure = not (row["known"] or one_team)
        return (
            row[merit] is None,
            unsure,
            row["island"] or 0,
            -(row[merit] or 0.0),
            row["player"] or "",
            row["iteration"] or 0,
            row["name"],
        )

    rows, ranks = sorted(rows, key=place), Counter[tuple[str, int | None]]()
    for row in rows:
        if row[merit] is not None and (row["known"] or one_team):
            among = row["roster"] if by_side else "", row["island"]
            ranks[among] += 1
            row["rank"] = ranks[among]
    return rows


def with_ticker(rows: Iterable[Row], elo: Mapping[str, float]) -> list[Row]:
    """Return the rows with an online Elo as `ticker`, ranked by it; snapshots without games come last, unranked."""
    met = [{**row, "ticker": elo.get(row["name"])} for row in rows]
    met.sort(key=lambda row: (row["ticker"] is None, -(row["ticker"] or 0.0), row["name"]))
    return [row | {"rank": i if row["ticker"] is not None else None} for i, row in enumerate(met, 1)]


def chosen(
    rows: Iterable[Row], players: Sequence[Player], teams: Mapping[str, int], team: str | None, role: str | None
) -> list[Row]:
    """Return the rows of a team, of a role, or of both; a snapshot of no player is of every team with its roster.

    Raises UnknownName, which lists the known names.
    """
    rows = list(rows)
    if team is not None:
        if team not in teams:
            raise UnknownName("team", team, teams)
        own = {p.name: p.roster for p in players if p.team == teams[team]}
        rows = [r for r in rows if r["player"] in own or (r["player"] is None and r["roster"] in own.values())]
    if role is not None:
        if role not in (roles := {*(p.role for p in players), FIXED}):
            raise UnknownName("role", role, roles)
        rows = [r for r in rows if r["role"] == role]
    return rows


def scores_against_initial(
    ladder: Ladder, snapshots: Sequence[Snapshot], players: Sequence[Player]
) -> dict[str, Score]:
    """Map each snapshot that has met its initial opponents to its score against them (see `progress_metrics`)."""
    payoff, first = ladder.payoff, [s for s in snapshots if s.initial]
    ends = [
        (i, payoff.index(s.name), payoff.index(o.name))
        for i, s in enumerate(snapshots)
        for o in initial_opponents(s, first, players)
    ]
    who, a, b = np.array(ends, int).reshape(-1, 3).T
    found = payoff.scores_of(a, b, who, len(snapshots))
    return {s.name: score for s, score in zip(snapshots, found, strict=True) if score.games}


def when(seconds: float) -> str | None:
    """Return a time on the database's clock as ISO 8601 in UTC, e.g. 2026-11-22T10:30:00Z; None for never."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ") if seconds else None


def moment(given: str | date) -> float:
    """Return a date or time, also in ISO 8601, as seconds since the epoch: the end of that day or second, in UTC.

    Raises ValueError.
    """
    text = given.isoformat() if isinstance(given, date) else given
    try:
        found = datetime.fromisoformat(text)
    except (TypeError, ValueError):
        raise ValueError("must be a date such as 2026-11-22, or a time such as 2026-11-22T10:30, in UTC") from None
    found = found if found.tzinfo else found.replace(tzinfo=UTC)
    return found.timestamp() + (86_400 if len(text) <= len("2026-11-22") else 1) - 1e-3


def unlike_sides(players: Sequence[Player]) -> list[str]:
    """Return the teams' rosters in their order if they differ; an empty list if all teams have the same roster."""
    rosters = list(dict.fromkeys(p.roster for p in sorted(players, key=lambda p: p.team)))
    return rosters if len(rosters) > 1 else []


def side_score(ladder: Ladder, snapshots: Iterable[Snapshot], one: str, other: str) -> Score:
    """Return one roster's score against another in all their games, which mixes the role with the players' skill."""
    payoff, rosters = ladder.payoff, {s.name: s.roster for s in snapshots}
    own, theirs = (np.array([rosters.get(name) == roster for name in payoff.names], bool) for roster in (one, other))
    a, b = payoff.first, payoff.second
    forward, back = own[a] & theirs[b], own[b] & theirs[a]
    i, j = np.concatenate([a[forward], b[back]]), np.concatenate([b[forward], a[back]])
    return payoff.scores_of(i, j, np.zeros(len(i), int), 1)[0]._replace(voids=0)


def side_text(roster: str) -> str:
    """Return a roster as text, e.g. `3 × predator`; with its side if another side has equal agents."""
    from arenas.description import describe_team  # imported here, because other queries load no arenas
    from arenas.rosters import roster_agents, roster_side

    members = describe_team(agent.partition(":")[0] for agent in roster_agents(roster))
    return f"{members} ({side})" if (side := roster_side(roster)) else members
