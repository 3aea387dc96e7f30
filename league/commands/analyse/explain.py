"""`league explain PLAYER`: the opponents that a player meets in training now, and why; of a snapshot, its lineage."""

import json
import shutil
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from dashboards.tables import Column, render
from league.commands.options import Where, parse, positional
from league.queries.league_facts import read_hyperparameters
from league.queries.opponents import explain_opponents, mark_present, opponent_columns
from league.queries.status_lines import copying
from league.state.league_state import LeagueState
from league.state.learner_changes import Ancestor, lineage
from storage.errors import UnknownName


@dataclass(frozen=True, kw_only=True)
class ExplainOptions(Where):
    """The player or snapshot and its league, and the format of the output."""

    player: str = positional()
    """The player that learns, or a snapshot, such as blue@16."""
    format: Literal["table", "json"] = "table"
    """table for people, json for programs."""


def explain(args: list[str]) -> int:
    """Print a player's opponents, or a snapshot's lineage."""
    what = "Whom a player meets in training now, how often, and why; from which snapshots a snapshot continues."
    options = parse(ExplainOptions, args, "explain", what)
    with options.open() as opened:
        state = LeagueState.of(opened.store, opened.league)
        if any(s.name == options.player for s in state.snapshots):
            _print_lineage(lineage(opened.store.snapshots(opened.league), options.player), options.format)
            return 0
        settings = opened.settings()
        role_of, seed = settings.roles(), settings.get("seed", otherwise=1)
        moved = read_hyperparameters(opened.store, settings, state).get(options.player)
    player = next((p for p in state.players if p.name == options.player), None)
    if player is None:
        if "@" in options.player:
            raise UnknownName("snapshot", options.player, [s.name for s in state.snapshots])
        raise UnknownName("player", options.player, [p.name for p in state.players])
    copies = None if moved is None else copying(settings.copies_after, state, player.name, moved)
    found = explain_opponents(role_of(player.role), state, player, seed) | {"population": copies}
    if options.format == "json":
        print(json.dumps(found, indent=2))
    else:
        print(_text(found))
        if found["population"]:
            print("\n" + _wrapped(f"Population: {options.player} has {found['population']}."))
    return 0


def _print_lineage(found: Sequence[Ancestor], format: Literal["table", "json"]) -> None:
    """Print a snapshot's lineage, oldest first."""
    rows = [
        {
            "snapshot": s.name, "player": s.player, "iteration": s.iteration, "steps": s.step,
            "seconds": round(s.seconds, 1), "parent": s.parent, "changes": list(changes),
        }
        for s, changes in found
    ]  # fmt: skip
    if format == "json":
        print(json.dumps({"snapshot": rows[-1]["snapshot"], "lineage": rows}, indent=2))
        return
    shown = ("snapshot", "iteration", "steps", "parent", Column("changes", "changed learner settings"))
    print(render([row | {"changes": ", ".join(row["changes"])} for row in rows], shown))


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
        shown = opponent_columns(team)
        parts += [_wrapped(" ".join(lines)), render(mark_present(team["opponents"]), shown)]
    parts.append(
        _wrapped(
            f"Win rates are those of the games that {found['player']} has learnt from, a draw counted half. After each"
            f" further game one counts {found['decay']:g} times as much. A record begins with {found['shrinkage']:g}"
            " virtual draws, or as that against the snapshot from which this one goes on."
        )
    )
    return "\n\n".join(parts)


def _wrapped(text: str) -> str:
    return textwrap.fill(text, shutil.get_terminal_size().columns)
