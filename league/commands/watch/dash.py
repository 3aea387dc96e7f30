"""`league dash`: a league as a page in a browser of this machine, which is updated while the league runs."""

import signal
import sys
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace

from league.commands.options import parse
from league.commands.watch.page_options import PageOptions
from league.system import exit_codes

PORT = 8710


@dataclass(frozen=True)
class DashOptions(PageOptions):
    """The league, its films, and the port that serves it."""

    port: int = field(default=PORT, metadata={"low": 1, "high": 65_535})
    """The port on 127.0.0.1; no other machine can reach it."""


def dash(args: list[str]) -> int:
    """Serve the page of a league until Ctrl-C or SIGTERM."""
    what = (
        "A league as a page that follows it, in a browser of this machine: what league report writes, kept up to date."
    )
    options = parse(DashOptions, args, "dash", what)
    from dashboards.system.ports import listen
    from dashboards.web import server
    from dashboards.web.document import FilmBlock, Page
    from dashboards.web.match_links import RecordedMatch
    from league.matches.match_clips import BackgroundClips
    from league.queries.match_players import players_of
    from league.queries.page import league_page
    from league.queries.query import Open
    from league.queries.recordings import RecordingQuery, chosen, load

    # uvicorn repeats the signal that has ended it: without a handler the viewer's folder would stay.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(exit_codes.DONE))
    with ExitStack() as stack:
        opened = stack.enter_context(options.open())
        listener = stack.enter_context(listen(options.port))

        # Without a name, the page shows the league that was run last, which may change.
        def now() -> Open:
            return Open(opened.store, options.league)

        def found(number: int) -> RecordedMatch:
            match = chosen(now(), RecordingQuery(number))
            recording, _ = load(now(), match)
            return recording, players_of(now(), match, recording.header.sides)

        clips = BackgroundClips(now, options.films)

        def version() -> str:
            return f"{league_page.version(now())}:{clips.version}"

        def page() -> Page:
            made = clips.version
            films = [FilmBlock(clip.caption, f"film/{clip.path.name}") for clip in clips.shown]
            current = league_page.page(now(), "match/", films or [FilmBlock(clips.note)])
            return replace(current, version=f"{current.version}:{made}")

        url = f"http://{server.HOST}:{options.port}/"
        print(f"League {opened.league}: {url} (Ctrl-C ends it; the league does not notice)", flush=True)
        if options.films:
            stack.enter_context(clips.running())
        with suppress(KeyboardInterrupt):
            server.serve(listener, version, page, found, clips.path)
    return 0
