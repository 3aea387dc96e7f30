"""`league watch`: a recorded match in 3D, in a window or a browser, as a file for rerun, a picture or a film."""

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from dashboards.cast import Performer
from dashboards.errors import ViewerError
from dashboards.outputs import FILMS, PICTURES, RERUN, examine
from league.cast import cast
from league.commands.options import Where, parse, positional
from league.commands.telling import Progress
from league.config.schema import ConfigError
from league.recorded import Wish, chosen, following, load
from storage.recording import Recording
from storage.records import Match

PICTURE, FILM = (1600, 1000), (960, 600)  # pixels


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
    """The picture's moment in seconds (default: two thirds into the match), or the film's first."""
    video: Path | None = None
    """Write a film, out.mp4, out.gif or out.webp; needs no display and no graphics driver."""
    seconds: float | None = field(default=None, metadata={"above": 0.0})
    """How much of the match the film shows (default: to its end)."""
    rate: int = field(default=20, metadata={"low": 1, "high": 50})
    """The film's pictures per second."""
    web: bool = False
    """In a browser on this machine instead of a window."""
    live: bool = False
    """Show every match that the league records, as soon as it is filed; the league does not notice."""
    port: int = field(default=9090, metadata={"low": 1, "high": 65534})
    """Where it is served to a browser, at 127.0.0.1."""

    def wish(self) -> Wish:
        """Which match. Raises ConfigError for two wishes at once, or one name between."""
        asked = {"MATCH": self.match is not None, "--best": self.best, "--upset": self.upset}
        given = [name for name, there in asked.items() if there]
        named = [name for name, there in (("--between", self.between), ("--player", self.player)) if there]
        if len(given) > 1 or (self.match is not None and named):
            raise ConfigError((), f"{' and '.join([*given, *named])} ask for different matches: give one of them")
        if self.live and (given or named or self.save or self.shot or self.video):
            raise ConfigError((), "--live shows every match as it comes, in a window or with --web: give it alone")
        if len(self.between) not in (0, 2):
            raise ConfigError((), f"--between takes two snapshots, as in --between a@8 b@8, not {len(self.between)}")
        return Wish(self.match, self.best, self.upset, self.between, self.player)


def watch(args: list[str]) -> int:
    """Show a recorded match."""
    options = parse(WatchOptions, _paired(args), "watch", "A recorded match in 3D.")
    wish = options.wish()
    for path, kinds in ((options.save, RERUN), (options.shot, PICTURES), (options.video, FILMS)):
        if path is not None:
            examine(path, kinds)
    if options.live:
        return _follow(options)
    with options.open() as opened:
        match = chosen(opened, wish)
        recording, missing = load(opened, match, options.episode, options.recover)
        who = cast(opened, match, recording.header.sides)
    print(told(match, recording))
    if missing:
        print(f"league: the recording is damaged: {missing}", file=sys.stderr)
    if not (options.save or options.shot or options.video):
        return _show(options, recording, who)
    from dashboards import viewer

    if options.save is not None:
        viewer.write_rrd(recording, options.save, who)
        print(f"Wrote {options.save}; `rerun {options.save}` opens it.")
    if options.shot is not None:
        _shoot(options, recording, who)
    if options.video is not None:
        _film(options, recording, who)
    return 0


def _show(options: WatchOptions, recording: Recording, who: Sequence[Performer]) -> int:
    """In a window, or in a browser until Ctrl-C."""
    from dashboards import viewer

    if not options.web:
        viewer.show(recording, who)
        return 0
    with suppress(KeyboardInterrupt), viewer.hub(options.port) as hub:
        hub.send(recording, who)
        print(f"{hub.address}\nshows it in a browser on this machine; Ctrl-C ends that.", flush=True)
        while True:
            time.sleep(1)
    return 0


def _follow(options: WatchOptions) -> int:
    """The newest match and each that follows, in a window or a browser, until Ctrl-C."""
    from dashboards import viewer

    with options.open() as opened, ExitStack() as stack, suppress(KeyboardInterrupt):
        send: Callable[[Recording, Sequence[Performer]], None] = viewer.show
        if options.web:
            hub = stack.enter_context(viewer.hub(options.port))
            send = hub.send
            print(f"{hub.address}\nshows it in a browser on this machine; Ctrl-C ends that.", flush=True)
        else:
            viewer.require_display("--live --web for a browser on this machine, or --save match.rrd for a file")
        for match in following(opened):
            recording, _ = load(opened, match)
            send(recording, cast(opened, match, recording.header.sides))
            print(told(match, recording), flush=True)
    return 0


def told(match: Match, recording: Recording) -> str:
    """A match in a line."""
    header = recording.header
    what = "Training" if match.purpose == "training" else "Match"
    return f"{what} {match.id}: {' against '.join(header.sides)}, {header.outcome}, {recording.time[-1]:.1f} s"


def _shoot(options: WatchOptions, recording: Recording, who: Sequence[Performer]) -> None:
    """With rerun's panels where a graphics driver is there; else by rays alone."""
    from dashboards import viewer
    from dashboards.film import Film, save_picture
    from dashboards.headless import NO_DRIVER

    path, at = options.shot, float(recording.time[-1]) * 2 / 3 if options.at is None else options.at
    assert path is not None
    try:
        viewer.shot(recording, path, at, cast=who)
    except ViewerError as error:
        if str(error) != NO_DRIVER:
            raise
        print(f"league: {NO_DRIVER}; without one it is drawn without curves and panels", file=sys.stderr)
        save_picture(Film(recording, PICTURE, who), path, at)
    print(f"Wrote {path}.")


def _film(options: WatchOptions, recording: Recording, who: Sequence[Performer]) -> None:
    from dashboards.film import Film, check, save_film

    path, begin = options.video, recording.time[0] if options.at is None else options.at
    assert path is not None
    check(path)
    end = recording.time[-1] if options.seconds is None else begin + options.seconds
    with Progress("league watch") as progress:
        tell = partial(progress.tell, "pictures")
        save_film(Film(recording, FILM, who), path, options.rate, (float(begin), float(end)), tell)
    print(f"Wrote {path}, {path.stat().st_size / 1e6:.1f} MB.")


def _paired(args: list[str]) -> list[str]:
    """The arguments with the two words after --between as the list that the option is."""
    if "--between" not in args:
        return args
    at = args.index("--between")
    names = [word for word in args[at + 1 : at + 3] if not word.startswith("--")]
    return [*args[: at + 1], ",".join(names), *args[at + 1 + len(names) :]] if len(names) == 2 else args
