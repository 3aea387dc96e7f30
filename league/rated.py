"""What a ladder says of each snapshot, as rows: what `league ratings` prints and `league.open(...).ratings()` gives."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from league.measures import initial_opponents
from matchmaking.ladder import Ladder
from matchmaking.payoff import Score, score_interval
from storage.errors import UnknownName
from storage.records import ArenaKey, Player, Snapshot

Row = dict[str, Any]
VOID_LIMIT = 0.02
"""Where a league's settings do not say (`rating.void_limit`) from which share on void episodes are suspect."""
FIXED = "fixed"
"""The role of what belongs to no player and never learns: scripts and imported policies."""


def rating_rows(
    ladder: Ladder, snapshots: Sequence[Snapshot], players: Sequence[Player], void_limit: float = VOID_LIMIT
) -> list[Row]:
    """See Open.ratings. Those whose rating is not known come after the others, and those that never played last."""
    ratings, payoff, one_team = ladder.ratings, ladder.payoff, ladder.one_team
    roles = {p.name: p.role for p in players}
    void = (payoff.episodes - payoff.games).sum(1) + payoff.trials[:, 2]
    counts = np.stack([payoff.wins.sum(1), payoff.draws.sum(1), payoff.losses.sum(1), void], 1).tolist()
    initial = scores_against_initial(ladder, snapshots, players)
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
            "elo": float(ratings.elo[i]) if met else None,
            "low": float(ratings.low[i]) if met else None,
            "high": float(ratings.high[i]) if met else None, "known": ladder.known(s.name),
            "games": games, "wins": wins, "draws": draws, "losses": losses,
            "voids": void,
            "win_rate": (wins + draws / 2) / games if met else None,
            "vs_initial": against.score if against else None,
            "vs_initial_low": against.low if against else None,
            "vs_initial_high": against.high if against else None,
            "success": tried.score if tried else None,
            "success_low": tried.low if tried else None, "success_high": tried.high if tried else None,
            "last_played": when(payoff.last[i]),
            "iteration": s.iteration if s.player else None, "seconds": round(s.seconds, 1) if s.player else None,
            "voids_own": voids.own, "voids_unclear": voids.unclear,
            "flagged": "!" if voids.own > void_limit else "?" if voids.suspect > void_limit else "",
            "tilt": float(ratings.tilts[ratings.population[i]]),
            "digest": s.digest, "roster": s.roster,
            **(ladder.arena or ArenaKey("", "", ""))._asdict(),
        })  # fmt: skip
    return _ranked(rows, "success" if one_team else "elo", one_team, bool(ladder.pool.populations))


def _ranked(rows: list[Row], merit: str, one_team: bool, by_side: bool) -> list[Row]:
    """The best first, with ranks for those whose merit is known: of each side, where sides are unlike."""

    def place(row: Row) -> tuple:
        unsure = not (row["known"] or one_team)
        return row[merit] is None, unsure, -(row[merit] or 0.0), row["player"] or "", row["iteration"] or 0, row["name"]

    rows, ranks = sorted(rows, key=place), Counter[str]()
    for row in rows:
        if row[merit] is not None and (row["known"] or one_team):
            side = row["roster"] if by_side else ""
            ranks[side] += 1
            row["rank"] = ranks[side]
    return rows


def with_ticker(rows: Iterable[Row], elo: Mapping[str, float]) -> list[Row]:
    """The rows with an online Elo as `ticker`, ranked by it; those who have not played come last, without a rank."""
    met = [{**row, "ticker": elo.get(row["name"])} for row in rows]
    met.sort(key=lambda row: (row["ticker"] is None, -(row["ticker"] or 0.0), row["name"]))
    return [row | {"rank": i if row["ticker"] is not None else None} for i, row in enumerate(met, 1)]


def chosen(
    rows: Iterable[Row], players: Sequence[Player], teams: Mapping[str, int], team: str | None, role: str | None
) -> list[Row]:
    """The rows of a team, of a role, or of both; what belongs to no player is of every team whose roster it has.

    Raises UnknownName, with those there are.
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
    """Of each snapshot that has met its initial opponents its score against them, as league.measures defines it."""
    first, counts = [s for s in snapshots if s.initial], {}
    for s in snapshots:
        found = ladder.payoff.against(s.name, [o.name for o in initial_opponents(s, first, players)])
        if any(found):
            counts[s.name] = found
    wins, draws, losses, *pairs = np.array(list(counts.values()), np.int64).reshape(-1, 8).T
    low, high = score_interval(wins, draws, losses, np.stack(pairs, 1))
    games = wins + draws + losses
    scored = zip(((wins + draws / 2) / games).tolist(), low.tolist(), high.tolist(), games.tolist(), strict=True)
    return {name: Score(*score) for name, score in zip(counts, scored, strict=True)}


def when(seconds: float) -> str | None:
    """A time on the database's clock as ISO 8601 in UTC, e.g. 2026-11-22T10:30:00Z; None for never."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ") if seconds else None


def moment(text: str) -> float:
    """A date or a time in ISO 8601 as seconds since the epoch: the end of that day, or of that second, in UTC.

    Raises ValueError.
    """
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        raise ValueError("must be a date such as 2026-11-22, or a time such as 2026-11-22T10:30, in UTC") from None
    found = found if found.tzinfo else found.replace(tzinfo=UTC)
    return found.timestamp() + (86_400 if len(text) <= len("2026-11-22") else 1) - 1e-3


def unlike_sides(players: Sequence[Player]) -> list[str]:
    """The rosters of the teams in their order, where these are unlike; none where all are of one roster."""
    rosters = list(dict.fromkeys(p.roster for p in sorted(players, key=lambda p: p.team)))
    return rosters if len(rosters) > 1 else []


def side_score(ladder: Ladder, snapshots: Iterable[Snapshot], one: str, other: str) -> Score:
    """How one roster has scored against another in all their games: role and skill in one, of whoever has played."""
    payoff, rosters = ladder.payoff, {s.name: s.roster for s in snapshots}
    met = np.ix_(*([rosters.get(name) == roster for name in payoff.names] for roster in (one, other)))
    wins, draws, losses = (int(counts[met].sum()) for counts in (payoff.wins, payoff.draws, payoff.losses))
    low, high = score_interval(wins, draws, losses)
    games = wins + draws + losses
    return Score((wins + draws / 2) / games if games else math.nan, float(low), float(high), games)


def side_text(roster: str) -> str:
    """A roster as people say it, e.g. `3 × predator`."""
    counts = Counter(agent.partition(":")[0] for agent in roster.split("+"))
    return " + ".join(f"{count} × {kind}" for kind, count in counts.items())
