"""`league presets`: the presets, a line each; `league presets NAME`: all settings of one."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from dashboards.tables import Column, render
from league.commands.options import parse, positional
from league.config import experiment as configuration
from league.config import presets as known


@dataclass(frozen=True)
class PresetsOptions:
    """The preset, and the format of the output."""

    name: str | None = positional(None)
    """A preset's name: all its settings, as a file for `league run`."""
    format: Literal["table", "json", "csv"] = "table"
    """table for people, json or csv for programs; of one preset TOML is printed."""


def presets(args: list[str]) -> int:
    """List the presets, or print one in full."""
    what = "The presets in a line each; of one that is named, all settings as TOML: league presets duel > league.toml."
    options = parse(PresetsOptions, args, "presets", what)
    if options.name is not None:
        print(configuration.dumps(known.preset(options.name)), end="")
        return 0
    rows = [*_rows()]
    if options.format != "table":
        print(render(rows, (), options.format))
        return 0
    print(render(rows, (Column("preset", no_wrap=True), "what")))
    print("\n`league run --preset NAME` runs one, `league presets NAME` prints its settings.")
    return 0


def _rows() -> Iterator[dict[str, Any]]:
    for name, make in known.PRESETS.items():
        what = " ".join((make.__doc__ or "").partition("\n\n")[0].split())
        yield {"preset": name, "arena": make().arena.name, "what": what}
