"""`league explain PLAYER`: whom a player meets in training now, and why."""

import json
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from dashboards.tables import Column, render
from league import population
from league.commands.options import Where, parse, positional
from league.lives import born
from league.odds import WIN_RATE, Odds, odds, records
from league.standing import Standing
from matchmaking.opponents import Opponents, Records
from matchmaking.roles import Role
from storage.errors import UnknownName
from storage.records import Player

SHOWN = (
    Column("opponent", whole=True), Column("probability", decimals=3), Column("win_rate", "win rate", 3), "games",
    Column("read", decimals=3), Column("inherits", "win rate of", whole=True),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ExplainOptions(Where):
    """Whose opponents of which league, and how to print them."""

    player: str = positional()
    """The player that learns."""
    format: Literal["table", "json"] = "table"
    """table for people, json for programs."""


def explain(args: list[str]) -> int:
    """Print a player's opponents."""
    options = parse(ExplainOptions, args, "explain", "Whom a player meets in training now, how often, and why.")
    with options.open() as opened:
        standing = Standing.of(opened.store, opened.league)
        role_of, seed = opened.roles(), opened.setting("seed", otherwise=1)
        told = population.words(opened, standing)
    player = next((p for p in standing.players if p.name == options.player), None)
    if player is None:
        raise UnknownName("player", options.player, [p.name for p in standing.players])
    found = explained(role_of(player.role), standing, player, seed) | {"population": told.get(options.player)}
    if options.format == "json":
        print(json.dumps(found, indent=2, ensure_ascii=False))
    else:
        print(_text(found))
        if found["population"]:
            print("\n" + _wrapped(f"Population: {options.player} has {found['population']}."))
    return 0


def explained(role: Role, standing: Standing, player: Player, seed: int = 1) -> dict[str, Any]:
    """A player's opponents, team by team: the odds of its next turn as plain values, for JSON.

    `role` says what it meets, `seed` is the league's, by which it is known whether the player has begun anew.
    """
    rule = role.opponents or Opponents()
    anew = born(role, seed, player.name, standing.history(player.name))
    since = -1 if anew is None else anew.iteration
    seats = {p.team: p.name for p in standing.groups[player.group] if p.team != player.team}
    others = sorted({p.team for p in standing.players} - {player.team})
    drawn = rule.true_share if all(team in seats for team in others) else 1.0
    known = records(rule, standing, player, since)
    phase = standing.phases.get(player.group)
    teams = []
    for team in others:
        at = odds(rule, standing, player, team, seats.get(team, ""), role, since)
        teams.append({"team": team, "why": at.mixture.why, "reads": at.told, "opponents": _rows(at, known, drawn)})
    learns = phase is None or player.name in phase.learners
    return {
        "player": player.name, "role": role.name, "kind": rule.kind, "share": drawn,
        "groups": rule.groups if drawn else 1, "decay": rule.decay, "shrinkage": rule.shrinkage,
        "learns": learns and player.paused is None and role.learns, "teams": teams,
    }  # fmt: skip


def _rows(at: Odds, known: Records, drawn: float) -> list[dict[str, Any]]:
    """A row for the opponent as it is now, and one for each snapshot, the newest first."""
    chances = at.weights * drawn
    chances[-1] += 1 - drawn
    rows = [_row(known, at.opponent, chances[-1], None) | {"present": True}] if at.opponent else []
    for i in reversed(range(len(at.names))):
        rows.append(_row(known, at.names[i], chances[i], None if at.read is None else float(at.read[i])))
    return rows


def _row(known: Records, name: str, chance: float, read: float | None) -> dict[str, Any]:
    source = known.source(name)
    return {
        "opponent": name, "present": False, "probability": float(chance),
        "win_rate": float(known.against(name).rate), "games": int(known.games([name])[0]),
        "read": read, "inherits": source if source != name else None,
    }  # fmt: skip


def _text(found: dict[str, Any]) -> str:
    if not found["teams"]:
        return f"{found['player']} has nobody to meet: there is one team."
    parts = []
    for team in found["teams"]:
        if found["share"]:
            share = f"in {100 * found['share']:.3g} % of its worlds"
            lines = [f"{found['player']} meets others by the rule {found['kind']}, {share}: {team['why']}."]
        else:
            lines = [f"{found['player']} meets the other team as it is now: the share of the past is 0."]
        if not found["learns"]:
            lines.append("It does not learn now.")
        shown = columns(team)
        parts += [_wrapped(" ".join(lines)), render(called(team["opponents"]), shown)]
    parts.append(
        _wrapped(
            f"Win rates are those of the games that {found['player']} has learnt from, a draw counted half. After each"
            f" further game one counts {found['decay']:g} times as much. A record begins with {found['shrinkage']:g}"
            " virtual draws, or as that against the snapshot from which this one goes on."
        )
    )
    return "\n\n".join(parts)


def called(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of opponents, those who are met as they are now called so."""
    return [{**row, "opponent": row["opponent"] + (" (as it is now)" if row["present"] else "")} for row in rows]


def columns(team: Mapping[str, Any]) -> Sequence[Column | str]:
    """Of a team's rows: what the rule has read beside win rates has a column of its own."""
    shown = []
    for column in SHOWN:
        key = column if isinstance(column, str) else column.key
        if key == "read" and team["reads"] in (WIN_RATE, ""):
            continue
        if key == "inherits" and not any(row["inherits"] for row in team["opponents"]):
            continue
        shown.append(Column("read", team["reads"], 3) if key == "read" else column)
    return shown


def _wrapped(text: str) -> str:
    return textwrap.fill(text, shutil.get_terminal_size().columns)
