"""`league arenas`: a line about each arena; `league arenas NAME`: all about one arena."""

import os
import shutil
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from dashboards.tables import Column, render
from league.commands import help
from league.commands.options import parse, positional, without_settings
from league.config import flags
from league.config.schema import ConfigError

NAMES = 26  # columns for an arena's name
PARTS = (Column("index", no_wrap=True), "what", Column("unit", no_wrap=True), "meaning")
TERMS = (Column("name", no_wrap=True), Column("kind", no_wrap=True), "what")


@dataclass(frozen=True)
class ArenasOptions:
    """The arena, and the format of the output."""

    name: str | None = positional(None)
    """An arena's name, or file.py:name for your own: all about it."""
    format: Literal["table", "json"] = "table"
    """table for people, json for programs."""


def arenas(args: list[str]) -> int:
    """List the arenas, or describe one in full."""
    own, given = without_settings(args, "arena")
    options = parse(
        ArenasOptions, own, "arenas",
        "The arenas in a line each; of one that is named: its teams, what its robots see and do, rewards, scripts,"
        " timing and settings. Flags such as --arena.blue change its settings.",
    )  # fmt: skip
    if options.name is None and given:
        raise ConfigError(("name",), "flags such as --arena.blue need an arena's name: league arenas sumo-1v1 ...")
    print(_listing(options.format) if options.name is None else _all_about(options.name, given, options.format))
    return 0


def _listing(format: Literal["table", "json"]) -> str:
    from arenas import known
    from league.queries.arena_info import line, outline

    rows = [line(name, outline(settings)) for name, settings in known().items()]
    if format == "json":
        return render(rows, (), format)
    more = "All about one: league arenas NAME, also of your own, which needs no registration: my/duel.py:duel"
    return "\n".join([*map(_entry, rows), "", _wrapped(more)])


def _entry(row: Mapping[str, Any]) -> str:
    """Describe an arena in two or three lines: its name, its teams and its summary."""
    head, indent = f"{row['arena']:<{NAMES}}{row['teams']}", " " * NAMES
    text = f"{row['what']}; {row['episode']:g} s, {row['decisions_per_second']:g} decisions/s, sees {row['sees']}"
    width = shutil.get_terminal_size().columns
    return f"{head}\n{textwrap.fill(text, width, initial_indent=indent, subsequent_indent=indent)}"


def _all_about(name: str, given: flags.Given, format: Literal["table", "json"]) -> str:
    from league.config.experiment import change, default

    found = change(default(name), given).arena
    os.environ["JAX_PLATFORMS"] = "cpu"  # nothing is simulated, and opening a GPU would take seconds
    from league.queries import arena_info

    try:
        sheet = arena_info.sheet(found)
    except (Exception, SystemExit) as error:
        if ":" not in name:  # an arena of this package
            raise
        from arenas.errors import describe_error, source_files

        text = f"arena {name}: {describe_error(error, source_files(name))}; `league check {name}` examines it"
        raise ConfigError(("name",), text) from error
    if format == "json":
        import json

        return json.dumps(arena_info.as_json(sheet), indent=2, default=dict)  # tables of a setting
    blocks = [
        f"{name}: {sheet.outline.what}",
        render(arena_info.team_rows(sheet)),
        _wrapped(arena_info.timing(sheet.outline)),
    ]
    for role in sheet.roles:
        blocks += [
            _titled(
                f"{role.kind} ({', '.join(role.agents)}) sees {arena_info.size(role.observation)}",
                render(arena_info.part_rows(role.observation), PARTS),
            )
        ]
    for role in sheet.roles:
        blocks += [
            _titled(
                f"{role.kind} acts with {arena_info.size(role.action)}",
                render(arena_info.part_rows(role.action), PARTS),
            )
        ]
    if sheet.privileged:
        title = f"a critic that may see the whole state (learner.critic_input) sees {arena_info.size(sheet.privileged)}"
        blocks += [_titled(title, render(arena_info.part_rows(sheet.privileged), PARTS))]
    if sheet.legend.score:
        blocks += [_titled("score", _wrapped(sheet.legend.score))]
    if terms := arena_info.term_rows(sheet.legend):
        blocks += [render(terms, TERMS)]
    blocks += ["Settings, as flags of `league run`; in league.toml they stand under [arena]:"]
    blocks += ["\n".join([title, *entries]) for title, entries in help.groups(found, ("arena",))]
    if sheet.page:
        blocks += [f"Its page: {sheet.page}{f', its picture: {sheet.picture}' if sheet.picture else ''}"]
    return "\n\n".join(blocks)


def _wrapped(text: str) -> str:
    return textwrap.fill(text, shutil.get_terminal_size().columns)


def _titled(title: str, text: str) -> str:
    return f"{title[:1].upper()}{title[1:]}\n{text}"
