"""`league watch`: a recorded match in 3D, in a window, as a file for rerun, or as a picture."""

import sys
from dataclasses import dataclass
from pathlib import Path

from league.cast import cast
from league.commands.options import Where, parse, positional
from league.config.schema import ConfigError
from league.recorded import Wish, chosen, load


@dataclass(frozen=True)
class WatchOptions(Where):
    """Which match, and how to look at it."""

    match: int | None = positional(None)
    """A match's number in `league matches` (default: the newest that was recorded)."""
    best: bool = False
    """The match between the best-rated snapshots instead."""
    upset: bool = False
    """The match in which the winner was rated the most below the loser."""
    between: tuple[str, ...] = ()
    """A match of these two snapshots: --between blue@64 red@8."""
    player: str | None = None
    """A match of this player."""
    episode: int = 0
    """Which of the match's recorded episodes: 0 is the first, 1 the first with sides swapped."""
    recover: bool = False
    """Of a damaged recording show what is whole."""
    save: Path | None = None
    """Write a file that `rerun` opens."""
    shot: Path | None = None
    """Write a picture; needs no display."""
    at: float | None = None
    """The picture's moment in seconds (default: two thirds into the match)."""

    def wish(self) -> Wish:
        """Which match. Raises ConfigError for two wishes at once, or one name between."""
        asked = {"MATCH": self.match is not None, "--best": self.best, "--upset": self.upset}
        given = [name for name, there in asked.items() if there]
        named = [name for name, there in (("--between", self.between), ("--player", self.player)) if there]
        if len(given) > 1 or (self.match is not None and named):
            raise ConfigError((), f"{' and '.join([*given, *named])} ask for different matches: give one of them")
        if len(self.between) not in (0, 2):
            raise ConfigError((), f"--between takes two snapshots, as in --between a@8 b@8, not {len(self.between)}")
        return Wish(self.match, self.best, self.upset, self.between, self.player)


def watch(args: list[str]) -> int:
    """Show a recorded match."""
    options = parse(WatchOptions, _paired(args), "watch", "A recorded match in 3D.")
    wish = options.wish()
    from dashboards import viewer

    with options.open() as opened:
        match = chosen(opened, wish)
        recording, missing = load(opened, match, options.episode, options.recover)
        who = cast(opened, match, recording.header.sides)
    header = recording.header
    print(f"Match {match.id}: {' against '.join(header.sides)}, {header.outcome}, {recording.time[-1]:.1f} s")
    if missing:
        print(f"league: the recording is damaged: {missing}", file=sys.stderr)
    if options.save is not None:
        viewer.write_rrd(recording, options.save, who)
        print(f"Wrote {options.save}; `rerun {options.save}` opens it.")
    if options.shot is not None:
        at = float(recording.time[-1]) * 2 / 3 if options.at is None else options.at
        viewer.shot(recording, options.shot, at, cast=who)
        print(f"Wrote {options.shot}.")
    if options.save is None and options.shot is None:
        viewer.show(recording, who)
    return 0


def _paired(args: list[str]) -> list[str]:
    """The arguments with the two words after --between as the list that the option is."""
    if "--between" not in args:
        return args
    at = args.index("--between")
    names = [word for word in args[at + 1 : at + 3] if not word.startswith("--")]
    return [*args[: at + 1], ",".join(names), *args[at + 1 + len(names) :]] if len(names) == 2 else args
