"""`league export` and `league import`: a frozen policy as a file, which any league of its arena can import."""

from collections.abc import Collection, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from league.commands.options import Where, parse, place_flags, positional, spelt
from league.config.schema import ConfigError
from league.config.sections import POLICY_FILE, check_name
from league.queries.query import Open
from league.snapshots import policy_file
from league.snapshots.exports import interface
from league.snapshots.exports.program_export import SUFFIX, Format, programs, stem
from league.snapshots.model_card import card
from league.snapshots.programs import exporting
from league.snapshots.programs.kinds import kind_of
from league.snapshots.transfer.arena_transfer import as_played, describe_transfer, refitted
from matchmaking.ratings.ladder import Ladder
from storage.blobs.files import new_file, require_file_name


@dataclass(frozen=True, kw_only=True)
class ExportOptions(Where):
    """The snapshot, and the files to write."""

    snapshot: str = positional()
    """The snapshot, such as blue@16, or a player, whose newest it is: `league snapshots` lists them."""
    checkpoint: bool = False
    """Take a player as its newest checkpoint has it, which may have learnt on since its newest snapshot."""
    output: str | None = None
    """The file to write, also as -o FILE; never over another one (none, with programs: the snapshot's name)."""
    onnx: bool = False
    """Write an ONNX file for each agent beside it, FILE.onnx or FILE-0.onnx, ..., with normalisation inside."""
    torchscript: bool = False
    """Write a TorchScript file for each agent beside it, FILE.pt or FILE-0.pt, ..."""
    card: str | None = None
    """The file of its model card (none: the file's name with .md)."""


def _named(value: str) -> None:
    if not value:
        raise ValueError("must be a name")
    check_name(value)
    if value.endswith(POLICY_FILE):  # `after` takes that for a file's path
        raise ValueError(f"a name does not end in {POLICY_FILE}, as a policy's file does")


@dataclass(frozen=True, kw_only=True)
class ImportOptions(Where):
    """The file, and the name of its policy in the league."""

    file: str = positional()
    """A file that `league export` wrote, the name of a policy that comes with the league, such as anymal-walk, or a
    program: an ONNX file (.onnx), a TorchScript file (.pt), file.py:function; one for each agent, with commas."""
    named: str | None = field(default=None, metadata={"flag": "as", "valid": _named})
    """The name that it has in the league."""
    team: str | None = None
    """The team whose roster a program plays (none: that of all teams, if they are alike)."""


def export(args: list[str]) -> int:
    """Write a frozen policy and its card."""
    what = (
        "Write a frozen policy as a safetensors file, with all that is known of it, and a card to read; one that is a"
        " program as the ONNX or TorchScript files that it is."
    )
    options = parse(ExportOptions, spelt(args), "export", what)
    formats: list[Format] = [name for name in SUFFIX if getattr(options, name)]
    if not formats:
        _need(options.output, "-o FILE", "export")
    with options.open() as league:
        written = stem(Path(options.output or options.snapshot))
        if kept := {} if options.checkpoint else exporting.files(league, options.snapshot, written):
            return _export_program(options, league.snapshot(options.snapshot).name, kept)
        _require_format(options.output, formats)
        policy, rated = _policy(options, league)
        path = Path(str(options.output)) if options.output else Path(f"{policy.about['name']}.safetensors")
        require_file_name(path)
        played = as_played(league, policy)
        files = programs(played.policy, stem(path), formats)
        path = stem(path).with_name(f"{stem(path).name}.safetensors") if formats else path
        page = Path(options.card) if options.card is not None else path.with_name(f"{path.name}.md")
        if page.absolute() in {each.absolute() for each in (path, *files)}:
            raise ConfigError(("card",), f"--card {page} is the file itself: give another name")
        by_agent: dict[int, list[str]] = {}
        for file, (number, _) in files.items():
            by_agent.setdefault(number, []).append(file.name)
        end = interface.section(policy, path.name, by_agent, played)
        text = card(league, policy.about, path.name, rated) + end
        with ExitStack() as opened:
            opened.enter_context(new_file(page)).write(text.encode())
            opened.enter_context(new_file(path)).write(data := policy.to_bytes())
            for file, (_, content) in files.items():
                opened.enter_context(new_file(file)).write(content)
    whose = f"{policy.about['name']} of league {policy.about['league']}"
    beside = f", {', '.join(map(str, files))}" if files else ""
    print(f"Wrote {whose} to {path} ({len(data):,} bytes){beside}, card {page}.")
    if formats and played.note:
        print(played.note)
    return 0


def _policy(options: ExportOptions, league: Open) -> tuple[policy_file.Policy, list[Ladder]]:
    """Return the policy to write, and the ladders on which it has played."""
    if options.checkpoint and (learnt_on := policy_file.export_checkpoint(league, options.snapshot)):
        return learnt_on, []
    rated = policy_file.ladders(league, league.snapshot(options.snapshot))
    return policy_file.export(league, options.snapshot, rated), rated


def _require_format(output: str | None, formats: Collection[Format]) -> None:
    """Raise ConfigError for the name of a file that would say another format than it has."""
    named = next((format for format, suffix in SUFFIX.items() if Path(output or "").suffix == suffix), None)
    if named and not formats:
        raise ConfigError(("output",), f"{output} would be a safetensors file: name it so, or add --{named}")


def _export_program(options: ExportOptions, name: str, kept: Mapping[Path, bytes]) -> int:
    """Write the files of a program, which is what it is; a card and other formats need a network that is known."""
    own = next(iter(kept)).suffix
    if other := next((each for each, suffix in SUFFIX.items() if getattr(options, each) and suffix != own), None):
        raise ConfigError((other,), f"{name} is a program in {own} files, and cannot be written as {other}")
    if options.card is not None:
        raise ConfigError(("card",), f"{name} is a program, of which no card is known: leave --card out")
    for path in kept:
        require_file_name(path)
    with ExitStack() as opened:
        for path, data in kept.items():
            opened.enter_context(new_file(path)).write(data)
    sizes = ", ".join(f"{path} ({len(data):,} bytes)" for path, data in kept.items())
    print(f"Wrote the program of {name} to {sizes}; `league import` and `league bench` take it.")
    return 0


def import_(args: list[str]) -> int:
    """Import a policy into a league."""
    what = (
        "Bring a policy into a league, as a fixed opponent that is rated with all others: one that `league export`"
        " wrote, or a program of yours. A Python file is run, now and for its matches; its path is stored, no code."
    )
    options = parse(ImportOptions, args, "import", what)
    _need(options.named, "--as NAME", "import")
    if kind := kind_of(options.file):
        return _import_program(options, kind)
    if options.team is not None:
        raise ConfigError(("team",), f"--team is for programs, and {options.file} tells its own roster: leave it out")
    policy = policy_file.read(policy_file.find(options.file))
    with options.open() as league:
        fitting = refitted(league, policy)
        snapshot = policy_file.bring_in(league, fitting, str(options.named))
        print(f"{snapshot.name} of league {league.league} is {snapshot.parent} ({snapshot.roster}).")
        if fitting is not policy:
            print(f"It learnt as {policy.about['roster']}: its sets of entities have other sizes here.")
        if text := describe_transfer(league, policy):
            print(text)
        print(_how_rated(options, league.league))
    return 0


def _import_program(options: ImportOptions, kind: str) -> int:
    from league.snapshots.programs import importing

    with options.open() as league:
        program, roster = importing.read(league, kind, options.file, options.team)
        snapshot = importing.bring_in(league, program, roster, str(options.named))
        print(f"{snapshot.name} of league {league.league} is {options.file} ({snapshot.roster}).")
        print(importing.describe(program))
        print(_how_rated(options, league.league))
    return 0


def _how_rated(options: ImportOptions, league: str) -> str:
    return f"Its rating matches are played by `league run {place_flags(options.store, league=league)}`."


def _need(value: str | None, what: str, command: str) -> None:
    if not value:
        raise ConfigError((), f"league {command} needs {what}: see league {command} --help")
