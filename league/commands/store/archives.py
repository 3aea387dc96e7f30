"""`league pack` and `league unpack`: leagues as one file, which can be added to any store."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from league.commands.options import STORE, Where, parse, place_flags, positional
from league.commands.progress_bar import Progress
from league.config.sections import check_name
from league.snapshots import archive
from storage.database.urls import display_location
from storage.store import Store


@dataclass(frozen=True)
class PackOptions:
    """The leagues to pack, and the file to write."""

    dest: str = positional()
    """The file to write, such as main.league.zip; never over another one."""
    league: tuple[str, ...] | None = None
    """Leagues, with commas (none: all of the store). What they need to go on comes along."""
    newest: bool = False
    """Only what is needed to go on and to be rated: no old checkpoints, no recordings."""
    no_recordings: bool = False
    """Everything but the recordings of matches."""
    store: str = STORE
    """The store: a folder, or a URL such as sqlite:///runs/league.db or postgresql://host/league."""
    blobs: str | None = None
    """Place of the store's policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""


def _named(value: str) -> None:
    if not value:
        raise ValueError("must be a name")
    check_name(value)


@dataclass(frozen=True)
class UnpackOptions:
    """The file to unpack, and the store to add it to."""

    archive: str = positional()
    """A file that `league pack` wrote."""
    store: str = STORE
    """The store, made if nothing is there: a folder, or a URL such as postgresql://host/league."""
    blobs: str | None = None
    """Place of the store's policies and recordings (none: ROBOT_LEAGUE_BLOBS if set, else beside a SQLite store)."""
    named: str | None = field(default=None, metadata={"flag": "as", "valid": _named})
    """Another name for the league, or for the curriculum with its stages."""


def pack(args: list[str]) -> int:
    """Write leagues as one file."""
    what = "Write a league, or all leagues of a store, as one file. They may run meanwhile."
    options = parse(PackOptions, _together(args, "--league"), "pack", what)
    progress = Progress("packing")
    with Store.open(options.store, blobs=options.blobs) as store:
        names, recordings = options.league or (), not options.no_recordings
        done = archive.pack(store, Path(options.dest), names, options.newest, recordings, progress.tell)
    progress.end()
    print(f"Packed {_summary(done)}: {done.bytes:,} bytes in {options.dest}.")
    if more := [name for name in done.leagues if name not in (options.league or done.leagues)]:
        print(f"With what they need to go on: {', '.join(more)}.")
    return 0


def unpack(args: list[str]) -> int:
    """Add the leagues of a file to a store."""
    what = (
        "Add the leagues in a file that `league pack` wrote to a store. All of it is checked before, or nothing done."
    )
    options = parse(UnpackOptions, args, "unpack", what)
    progress = Progress("unpacking")
    done = archive.unpack(Path(options.archive), options.store, options.blobs, options.named, progress.tell)
    progress.end()
    where = Where(options.store, done.leagues[0], options.blobs)
    print(f"Unpacked {_summary(done)} into {display_location(options.store)}.")
    if options.named is not None:
        print("Recordings, and the settings kept with runs and snapshots, still tell the old name: they never change.")
    found_by = place_flags(where.store, where.blobs, where.league)
    print(f"`league run {found_by}` goes on; `league ratings {found_by}` tells who is better.")
    return 0


def _summary(done: archive.Moved) -> str:
    counts = {table: done.rows[table] for table in ("snapshots", "checkpoints", "matches")}
    counts["matches"] += done.rows.get("ranked_matches", 0)
    rows = ", ".join(f"{number:,} {table}" for table, number in counts.items())
    names = f"league {done.leagues[0]}" if len(done.leagues) == 1 else f"leagues {', '.join(done.leagues)}"
    return f"{names} ({rows}; {done.blobs:,} blobs)"


def _together(args: Sequence[str], flag: str) -> list[str]:
    """Return the arguments with repetitions of a flag merged into one, its values joined by commas."""
    rest, values, left = [], [], list(args)
    while left:
        word = left.pop(0)
        if word == flag and left and not left[0].startswith("--"):
            values.append(left.pop(0))
        elif word.startswith(f"{flag}="):
            values.append(word.partition("=")[2])
        else:
            rest.append(word)
    return [*rest, *([f"{flag}={','.join(values)}"] if values else [])]
