"""A player's opponents in training now, as plain values with the columns of their table."""

from collections.abc import Mapping, Sequence
from typing import Any

from dashboards.tables import Column
from league.queries.player_copies import describe_copies
from league.queries.query import Open
from league.scheduling.opponent_sampling import WIN_RATE, OpponentDistribution, opponent_distribution, records
from league.state.league_state import LeagueState
from matchmaking.opponents import Opponents, WinRecords
from matchmaking.roles import Role
from storage.errors import UnknownName
from storage.records import Player

SHOWN = (
    Column("opponent", no_wrap=True), Column("probability", decimals=3), Column("win_rate", "win rate", 3), "games",
    Column("read", decimals=3), Column("inherits", "win rate of", no_wrap=True),
)  # fmt: skip


def explained(opened: Open, name: str) -> dict[str, Any]:
    """Return `explain_opponents` of a player of a league, and what it copies as `population` (None: nothing).

    Raises UnknownName.
    """
    state = LeagueState.of(opened.store, opened.league)
    player = next((p for p in state.players if p.name == name), None)
    if player is None:
        raise UnknownName("player", name, [p.name for p in state.players])
    settings = opened.settings()
    copies = describe_copies(opened.store, settings, state).get(name)
    role, seed = settings.roles()(player.role), settings.get("seed", otherwise=1)
    return explain_opponents(role, state, player, seed) | {"population": copies}


def explain_opponents(
    role: Role, state: LeagueState, player: Player, seed: int = 1, most: int | None = None
) -> dict[str, Any]:
    """Return a player's opponents by team, with their probabilities in its next turn, as plain values for JSON.

    `role` has the rule for opponents; `seed` is the league's and decides whether the player was reset. With `most`,
    only so many of the newest opponents of a team are in `opponents`, the others in `older`, with nothing but their
    probabilities: looking up what is known of each takes long where many players may meet many snapshots.
    """
    rule = role.opponents or Opponents()
    reset = role.last_reset(seed, player.name, state.history(player.name))
    since = -1 if reset is None else reset.iteration
    seats = {p.team: p.name for p in state.groups[player.group] if p.team != player.team}
    others = sorted({p.team for p in state.players} - {player.team})
    drawn = rule.actual_share if all(team in seats for team in others) else 1.0
    known = records(rule, state, player, since)
    phase = state.phases.get(player.group)
    teams = []
    for team in others:
        at = opponent_distribution(rule, state, player, team, seats.get(team, ""), role, since)
        rows, older = _rows(at, known, drawn, most)
        teams.append(
            {
                "team": team,
                "players": [p.name for p in state.players if p.team == team],
                "why": at.mixture.why,
                "reads": at.quantity,
                "opponents": rows,
            }
            | ({} if most is None else {"older": older})
        )
    learns = phase is None or player.name in phase.learners
    return {
        "player": player.name, "role": role.name, "kind": rule.kind, "share": drawn,
        "groups": rule.groups if drawn else 1, "decay": rule.decay, "shrinkage": rule.shrinkage,
        "learns": learns and player.paused is None and role.learns, "teams": teams,
    }  # fmt: skip


def _rows(
    at: OpponentDistribution, known: WinRecords, drawn: float, most: int | None
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return a row for the present opponent and a row for each snapshot, newest first; those after `most` are brief."""
    chances = at.mixture.weights * drawn
    chances[-1] += 1 - drawn
    rows = [_row(known, at.opponent, chances[-1], None) | {"present": True}] if at.opponent else []
    whole = len(at.names) if most is None else min(len(at.names), most - len(rows))
    older = len(at.names) - whole
    for i in reversed(range(older, len(at.names))):
        rows.append(_row(known, at.names[i], chances[i], None if at.read is None else float(at.read[i])))
    brief = zip(reversed(at.names[:older]), reversed(chances[:older].tolist()), strict=True)
    return rows, [{"opponent": name, "present": False, "probability": chance} for name, chance in brief]


def _row(known: WinRecords, name: str, chance: float, read: float | None) -> dict[str, Any]:
    source = known.source(name)
    return {
        "opponent": name, "present": False, "probability": float(chance),
        "win_rate": float(known.against(name).rate), "games": int(known.games([name])[0]),
        "read": read, "inherits": source if source != name else None,
    }  # fmt: skip


def team_named(team: Mapping[str, Any]) -> str:
    """Return what a team is called where there are several others: its number, and who plays it."""
    return f"team {team['team']} ({', '.join(team['players'])})"


def mark_present(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of opponents with a remark after the name of each present (not frozen) opponent."""
    return [{**row, "opponent": row["opponent"] + (" (as it is now)" if row["present"] else "")} for row in rows]


def opponent_columns(team: Mapping[str, Any]) -> Sequence[Column | str]:
    """Return the columns for a team's rows; a value that the rule reads instead of win rates gets its own column."""
    shown = []
    for column in SHOWN:
        key = column if isinstance(column, str) else column.key
        if key == "read" and team["reads"] in (WIN_RATE, ""):
            continue
        if key == "inherits" and not any(row["inherits"] for row in team["opponents"]):
            continue
        shown.append(Column("read", team["reads"], 3) if key == "read" else column)
    return shown
