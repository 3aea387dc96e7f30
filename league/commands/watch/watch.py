"""`league watch`: a recorded match in 3D, in a window or a browser, as a file for rerun, a picture or a film."""

import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass

from dashboards.identity import MatchPlayer
from league.commands.options import Where, parse, positional
from league.commands.watch.view import ViewOptions, view
from league.config.schema import ConfigError
from league.queries.match_players import players_of
from league.queries.recordings import RecordingQuery, chosen, describe_match, following, load
from storage.recordings.recording import Recording


@dataclass(frozen=True)
class WatchOptions(ViewOptions, Where):
    """The match, and the way in which it is shown or written."""

    match: int | None = positional(None)
    """A match's number in `league matches` (default: of the latest snapshots whose match was recorded)."""
    best: bool = False
    """The match between the best-rated snapshots instead."""
    upset: bool = False
    """The match in which the winner was rated the most below the loser."""
    closest: bool = False
    """The match between two snapshots whose score was nearest to one half."""
    between: tuple[str, ...] = ()
    """A match of these two snapshots, and of more teams others too: --between blue@64 red@8."""
    player: str | None = None
    """A match of this player."""
    episode: int = 0
    """Number of the recorded episode: 0 is the first, 1 the first with sides swapped."""
    recover: bool = False
    """Show the readable part of a damaged recording."""
    live: bool = False
    """Show every match that the league records, as soon as it is filed; the league does not notice."""

    def query(self) -> RecordingQuery:
        """Return the requested match. Raises ConfigError for two requests at once, or for --between with one name."""
        query = RecordingQuery(self.match, self.best, self.upset, self.closest, self.between, self.player)
        if query.clashing:
            given = " and ".join("MATCH" if name == "match" else f"--{name}" for name in query.clashing)
            raise ConfigError((), f"{given} ask for different matches: give one of them")
        if self.live and (query != RecordingQuery() or self.writes):
            raise ConfigError((), "--live shows every match as it comes, in a window or with --web: give it alone")
        if len(self.between) not in (0, 2):
            raise ConfigError((), f"--between takes two snapshots, as in --between a@8 b@8, not {len(self.between)}")
        return query


def watch(args: list[str]) -> int:
    """Show a recorded match."""
    options = parse(WatchOptions, _paired(args), "watch", "A recorded match in 3D.")
    query = options.query()
    options.require_outputs()
    if options.live:
        return _follow(options)
    with options.open() as opened:
        match = chosen(opened, query)
        recording, missing = load(opened, match, options.episode, options.recover)
        who = players_of(opened, match, recording.header.sides)
    print(describe_match(match, recording))
    if missing:
        print(f"league: the recording is damaged: {missing}", file=sys.stderr)
    view(options, recording, who)
    return 0


def _follow(options: WatchOptions) -> int:
    """Show the newest match and each later one, in a window or a browser, until Ctrl-C."""
    from dashboards import viewer

    with options.open() as opened, ExitStack() as stack, suppress(KeyboardInterrupt):
        send: Callable[[Recording, Sequence[MatchPlayer]], None] = viewer.show
        if options.web:
            hub = stack.enter_context(viewer.hub(options.port))
            send = hub.send
            ends = "Ctrl-C ends that, and with `league run --live` the league too"
            print(f"{hub.address}\nshows each match in a browser on this machine; {ends}.", flush=True)
        else:
            viewer.require_display("--live --web for a browser on this machine, or --save match.rrd for a file")
        for match in following(opened):
            recording, _ = load(opened, match)
            send(recording, players_of(opened, match, recording.header.sides))
            print(describe_match(match, recording), flush=True)
    return 0


def _paired(args: list[str]) -> list[str]:
    """Return the arguments with the two words after --between joined to a list, the option's type."""
    if "--between" not in args:
        return args
    at = args.index("--between")
    names = [word for word in args[at + 1 : at + 3] if not word.startswith("--")]
    return [*args[: at + 1], ",".join(names), *args[at + 1 + len(names) :]] if len(names) == 2 else args
