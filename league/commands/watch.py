"""`league watch`: a recorded match in 3D, in a window, as a file for rerun, or as a picture."""

from dataclasses import dataclass
from pathlib import Path

from league.commands.options import Where, parse, positional
from league.query import Open
from storage.errors import StorageError
from storage.recording import from_bytes
from storage.records import Match


@dataclass(frozen=True)
class WatchOptions(Where):
    """Which match, and how to look at it."""

    match: int | None = positional(None)
    """A match's number in `league matches` (default: the last one between the two best-rated snapshots)."""
    save: Path | None = None
    """Write a file that `rerun` opens."""
    shot: Path | None = None
    """Write a picture; needs no display."""
    at: float | None = None
    """The picture's moment in seconds (default: two thirds into the match)."""


def watch(args: list[str]) -> int:
    """Show a recorded match."""
    options = parse(WatchOptions, args, "watch", "A recorded match in 3D.")
    from dashboards import viewer

    with options.open() as opened:
        match = _choose(opened, options.match)
        recording = from_bytes(opened.store.blobs.get(str(match.recording)))
    header = recording.header
    print(f"Match {match.id}: {' against '.join(header.sides)}, {header.outcome}, {recording.time[-1]:.1f} s")
    if options.save is not None:
        viewer.write_rrd(recording, options.save)
        print(f"Wrote {options.save}; `rerun {options.save}` opens it.")
    if options.shot is not None:
        at = float(recording.time[-1]) * 2 / 3 if options.at is None else options.at
        viewer.shot(recording, options.shot, at)
        print(f"Wrote {options.shot}.")
    if options.save is None and options.shot is None:
        viewer.show(recording)
    return 0


def _choose(opened: Open, number: int | None) -> Match:
    """The match asked for, or the recorded one whose weaker side is best rated, the newest of those."""
    matches = opened.store.matches(opened.league)
    recorded = [m for m in matches if m.recording is not None]
    if number is not None:
        found = [m for m in matches if m.id == number]
        if not found:
            raise StorageError(f"There is no match {number} in league {opened.league}: `league matches` lists them.")
        if found[0].recording is None:
            raise StorageError(f"Match {number} was not recorded: `league matches` tells which were.")
        return found[0]
    if not recorded:
        raise StorageError(f"League {opened.league} has no recorded match yet: `league run` plays and records some.")
    learnt = {s.name for s in opened.store.snapshots(opened.league) if s.player is not None}
    key = recorded[-1].arena  # Elo of two ladders cannot be compared
    ladder = opened.ladder(key)

    def strength(name: str) -> float:
        return (
            ladder.success(name).score
            if ladder.one_team
            else float(ladder.ratings.strength[ladder.ratings.index(name)])
        )

    def interest(match: Match) -> tuple[bool, float, int]:
        sides = [side for side in (match.a, match.b) if side is not None]
        return learnt.issuperset(sides), min(map(strength, sides)), match.id

    return max((m for m in recorded if m.arena == key), key=interest)
