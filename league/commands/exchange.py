"""`league export` and `league import`: a frozen policy as a file, and from there into any league of its arena."""

import shlex
from dataclasses import dataclass, field
from pathlib import Path

from league import exchange
from league.cards import card
from league.commands.options import STORE, Where, parse, positional, spelt
from league.config.schema import ConfigError
from league.config.sections import check_name
from storage.files import whole_file
from storage.places import shown_place


@dataclass(frozen=True, kw_only=True)
class ExportOptions(Where):
    """Which snapshot, and where to."""

    snapshot: str = positional()
    """The snapshot, such as blue@16, or a player, whose newest it is: `league snapshots` lists them."""
    output: str | None = None
    """The file to write, also as -o FILE; never over another one."""
    card: str | None = None
    """The file of its model card (none: the file's name with .md)."""


def _named(value: str) -> None:
    if not value:
        raise ValueError("must be a name")
    check_name(value)


@dataclass(frozen=True, kw_only=True)
class ImportOptions(Where):
    """Which file, and as whom."""

    file: str = positional()
    """A file that `league export` wrote, or the name of a policy that comes with the league, such as anymal-walk."""
    named: str | None = field(default=None, metadata={"flag": "as", "valid": _named})
    """The name that it has in the league."""


def export(args: list[str]) -> int:
    """Write a frozen policy and its card."""
    what = "Write a frozen policy as a safetensors file, with all that is known of it, and a card to read."
    options = parse(ExportOptions, spelt(args), "export", what)
    _need(options.output, "-o FILE", "export")
    path = Path(str(options.output))
    page = Path(options.card) if options.card is not None else path.with_name(f"{path.name}.md")
    if page.absolute() == path.absolute():
        raise ConfigError(("card",), f"--card {page} is the file itself: give another name")
    with options.open() as league:
        policy = exchange.export(league, options.snapshot)
        text = card(league, policy.about, path.name)
        with whole_file(page) as told, whole_file(path) as file:
            told.write(text.encode())
            file.write(data := policy.to_bytes())
    whose = f"{policy.about['name']} of league {policy.about['league']}"
    print(f"Wrote {whose} to {path} ({len(data):,} bytes), card {page}.")
    return 0


def import_(args: list[str]) -> int:
    """Bring a policy into a league."""
    what = "Bring a policy that `league export` wrote into a league, as a fixed opponent that is rated with all others."
    options = parse(ImportOptions, args, "import", what)
    _need(options.named, "--as NAME", "import")
    policy = exchange.read(exchange.find(options.file))
    with options.open() as league:
        snapshot = exchange.bring_in(league, policy, str(options.named))
        where = shlex.join(["--store", shown_place(options.store)]) + " " if options.store != STORE else ""
        print(f"{snapshot.name} of league {league.league} is {snapshot.parent} ({snapshot.roster}).")
        print(f"Its rating matches are played by `league run {where}--league {league.league}`.")
    return 0


def _need(value: str | None, what: str, command: str) -> None:
    if not value:
        raise ConfigError((), f"league {command} needs {what}: see league {command} --help")
