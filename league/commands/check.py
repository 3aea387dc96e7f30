"""`league check`: whether an arena keeps the contract."""

from dataclasses import dataclass

from arenas.options import EngineName
from league.commands.options import parse, positional


@dataclass(frozen=True)
class CheckOptions:
    """What to examine, and with which engine."""

    name: str = positional()
    """An arena's name, or file.py:name for your own."""
    engine: EngineName = "auto"
    """Physics to examine it with."""


def check(args: list[str]) -> int:
    """Examine an arena against the contract: exit code 0 if it keeps it, 1 if not.

    What the arena's own code does wrong, be it that it raises, exits or leaves a hook out, is a failed promise with the
    line in its file; a name that is unknown is bad input.
    """
    options = parse(CheckOptions, args, "check", "Examine an arena against the contract that the league relies on.")
    from arenas.check import examine

    found = examine(options.name, engine=options.engine)
    for promise, ok, detail in found:
        print(f"{'ok    ' if ok else 'FAILED'}  {promise}{': ' + detail if detail else ''}")
    return 0 if all(ok for _, ok, _ in found) else 1
