"""`league arenas`: what arenas there are, in a line each; `league arenas NAME`: all about one of them."""

import os
import shutil
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from dashboards.tables import Column, render
from league.commands import help
from league.commands.options import parse, positional

NAMES = 26  # columns for an arena's name
PARTS = (Column("index", whole=True), "what", Column("unit", whole=True), "meaning")
TERMS = (Column("name", whole=True), Column("kind", whole=True), "what")


@dataclass(frozen=True)
class ArenasOptions:
    """Which arena, and how to print."""

    name: str | None = positional(None)
    """An arena's name, or file.py:name for your own: all about it."""
    format: Literal["table", "json"] = "table"
    """table for people, json for programs."""


def arenas(args: list[str]) -> int:
    """List the arenas, or tell all about one."""
    options = parse(
        ArenasOptions, args, "arenas",
        "The arenas in a line each; of one that is named: its teams, what its robots see and do, rewards, scripts,"
        " timing and settings.",
    )  # fmt: skip
    print(_listing(options.format) if options.name is None else _all_about(options.name, options.format))
    return 0


def _listing(format: Literal["table", "json"]) -> str:
    from arenas import known
    from league.sheets import line, outline

    rows = [line(name, outline(settings)) for name, settings in known().items()]
    if format == "json":
        return render(rows, (), format)
    more = "All about one: league arenas NAME, also of your own, which needs no registration: my/duel.py:duel"
    return "\n".join([*map(_entry, rows), "", _wrapped(more)])


def _entry(row: Mapping[str, Any]) -> str:
    """An arena in two lines or three: its name and teams, and what it is about."""
    head, indent = f"{row['arena']:<{NAMES}}{row['teams']}", " " * NAMES
    told = f"{row['what']}; {row['episode']:g} s, {row['decisions_per_second']:g} decisions/s, sees {row['sees']}"
    width = shutil.get_terminal_size().columns
    return f"{head}\n{textwrap.fill(told, width, initial_indent=indent, subsequent_indent=indent)}"


def _all_about(name: str, format: Literal["table", "json"]) -> str:
    from arenas import settings

    found = settings(name)
    os.environ["JAX_PLATFORMS"] = "cpu"  # nothing is simulated, and a GPU would take seconds to be opened
    from league import sheets

    sheet = sheets.sheet(found)
    if format == "json":
        import json

        return json.dumps(sheets.as_json(sheet), indent=2, ensure_ascii=False)
    blocks = [f"{name}: {sheet.outline.what}", render(sheets.team_rows(sheet)), _wrapped(sheets.timing(sheet.outline))]
    for role in sheet.roles:
        blocks += [
            _titled(
                f"{role.kind} ({', '.join(role.agents)}) sees {sheets.size(role.observation)}",
                render(sheets.part_rows(role.observation), PARTS),
            )
        ]
    for role in sheet.roles:
        blocks += [
            _titled(f"{role.kind} acts with {sheets.size(role.action)}", render(sheets.part_rows(role.action), PARTS))
        ]
    if sheet.privileged:
        title = f"a critic that may see the whole state (learner.critic_input) sees {sheets.size(sheet.privileged)}"
        blocks += [_titled(title, render(sheets.part_rows(sheet.privileged), PARTS))]
    if sheet.legend.score:
        blocks += [_titled("score", _wrapped(sheet.legend.score))]
    if terms := sheets.term_rows(sheet.legend):
        blocks += [render(terms, TERMS)]
    blocks += ["Settings, as flags of `league run`; in league.toml they stand under [arena]:"]
    blocks += ["\n".join([title, *entries]) for title, entries in help.groups(found, ("arena",))]
    if sheet.page:
        blocks += [f"Its page: {sheet.page}, its picture: {sheet.picture}"]
    return "\n\n".join(blocks)


def _wrapped(text: str) -> str:
    return textwrap.fill(text, shutil.get_terminal_size().columns)


def _titled(title: str, text: str) -> str:
    return f"{title[:1].upper()}{title[1:]}\n{text}"
