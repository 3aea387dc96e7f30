"""`league explain PLAYER`: the opponents that a player meets in training now, and why; of a snapshot, its lineage."""

import json
import shutil
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from dashboards.tables import Column, render
from league.commands.options import Where, parse, positional
from league.queries.opponents import explained, mark_present, opponent_columns, team_named
from league.state.setting_changes import Ancestor, lineage
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
        snapshots = opened.store.snapshots(opened.league, brief=True)
        names = [s.name for s in snapshots]
        if options.player in names:
            line = [each.snapshot.name for each in lineage(snapshots, options.player)]
            whole = opened.store.snapshots(opened.league, named=line)  # with their settings, which are long
            _print_lineage(lineage(whole, options.player), options.format)
            return 0
        if "@" in options.player:
            raise UnknownName("snapshot", options.player, names)
        found = explained(opened, options.player)
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
        several = len(found["teams"]) > 1
        if found["share"]:
            others = f"others of {team_named(team)}" if several else "others"
            share = f"in {100 * found['share']:.3g} % of its worlds"
            lines = [f"{found['player']} meets {others} by the rule {found['kind']}, {share}: {team['why']}."]
        else:
            other = team_named(team) if several else "the other team"
            lines = [f"{found['player']} meets {other} as it is now: the share of the past is 0."]
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
