"""`league check`: test whether an arena keeps the contract."""

from dataclasses import dataclass

from arenas.arena_settings import EngineName
from league.commands.options import parse, positional, without_settings
from league.commands.progress_bar import report_kernels


@dataclass(frozen=True)
class CheckOptions:
    """The arena to examine, and the engine."""

    name: str = positional()
    """An arena's name, or file.py:name for your own."""
    engine: EngineName = "auto"
    """Physics to examine it with."""


def check(args: list[str]) -> int:
    """Examine an arena against the contract; return exit code 0 if the arena keeps the contract, 1 if not.

    A fault of the arena's own code, which may raise, exit or lack a hook, is reported as a failed check with the line
    in its file. An unknown name is bad input.
    """
    own, given = without_settings(args, "arena")
    options = parse(
        CheckOptions, own, "check",
        "Examine an arena against the contract that the league relies on. Flags such as --arena.blue change its"
        " settings.",
    )  # fmt: skip
    from arenas.contract.check import examine
    from league.config.experiment import change, default

    with report_kernels():
        found = examine(
            options.name,
            (lambda _: change(default(options.name), given).arena) if given else None,
            engine=options.engine,
        )
    for check, ok, detail in found:
        print(f"{'ok    ' if ok else 'FAILED'}  {check}{': ' + detail if detail else ''}")
    return 0 if all(ok for _, ok, _ in found) else 1
