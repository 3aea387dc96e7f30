"""`league check`: test whether an arena keeps the contract."""

from dataclasses import dataclass, field
from typing import Any

from arenas.arena_settings import EngineName, Table
from league.commands.options import parse, positional
from league.commands.progress_bar import report_kernels
from league.config.build import build


@dataclass(frozen=True)
class CheckOptions:
    """The arena to examine, and the engine."""

    name: str = positional()
    """An arena's name, or file.py:name for your own."""
    engine: EngineName = "auto"
    """Physics to examine it with."""
    reward_terms: Table = field(default_factory=Table)
    """Terms to examine with it, as in arena.reward.terms: '{upright = "my/terms.py:upright"}'."""
    observation_terms: Table = field(default_factory=Table)
    """The same, as in arena.observation_terms."""


def check(args: list[str]) -> int:
    """Examine an arena against the contract; return exit code 0 if the arena keeps the contract, 1 if not.

    A fault of the arena's own code, which may raise, exit or lack a hook, is reported as a failed promise with the line
    in its file. An unknown name is bad input.
    """
    options = parse(CheckOptions, args, "check", "Examine an arena against the contract that the league relies on.")
    from arenas.contract.check import examine

    with report_kernels():
        found = examine(options.name, lambda settings: _with_terms(settings, options), engine=options.engine)
    for check, ok, detail in found:
        print(f"{'ok    ' if ok else 'FAILED'}  {check}{': ' + detail if detail else ''}")
    return 0 if all(ok for _, ok, _ in found) else 1


def _with_terms(settings: Any, options: CheckOptions) -> Any:
    """Return an arena's settings with the terms of the command line. Raises ConfigError if they take none."""
    table: dict[str, Any] = {}
    if options.reward_terms:
        table["reward"] = {"terms": dict(options.reward_terms)}
    if options.observation_terms:
        table["observation_terms"] = dict(options.observation_terms)
    return build(type(settings), table, settings) if table else settings
