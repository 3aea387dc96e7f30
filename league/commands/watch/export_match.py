"""`league export-match`: a recorded match as a file that other viewers open in 3D."""

from dataclasses import dataclass
from pathlib import Path

from league.commands.options import Where, parse, positional, spelt
from league.config.schema import ConfigError
from league.queries.match_players import players_of
from league.queries.recordings import RecordingQuery, chosen, load


@dataclass(frozen=True, kw_only=True)
class ExportOptions(Where):
    """The match, and the file to write."""

    match: int = positional()
    """A match's number in `league matches`."""
    episode: int = 0
    """Number of the recorded episode."""
    foxglove: bool = False
    """As MCAP with the scene and transforms of Foxglove, and what rerun draws of an MCAP file by itself."""
    output: Path | None = None
    """The file to write, also as -o FILE; never over another one (default: match-NUMBER.mcap here)."""


def export_match(args: list[str]) -> int:
    """Write a match for other viewers."""
    options = parse(ExportOptions, spelt(args), "export-match", "A recorded match as a file for other viewers.")
    if not options.foxglove:
        raise ConfigError((), "league export-match has one kind of file as yet: give --foxglove")
    from dashboards.export.foxglove import write_foxglove

    path = options.output or Path(f"match-{options.match}.mcap")
    with options.open() as opened:
        match = chosen(opened, RecordingQuery(options.match))
        recording, _ = load(opened, match, options.episode)
        write_foxglove(recording, path, players_of(opened, match, recording.header.sides))
    print(f"Wrote {path} ({path.stat().st_size / 1e6:.1f} MB): Foxglove and `rerun {path}` open it in 3D.")
    return 0
