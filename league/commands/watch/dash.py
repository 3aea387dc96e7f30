"""`league dash`: a league as a page in a browser of this machine, which is updated as the league goes on."""

from dataclasses import dataclass, field

from league.commands.options import Where, parse

PORT = 8710


@dataclass(frozen=True)
class DashOptions(Where):
    """The league, and the port that serves it."""

    port: int = field(default=PORT, metadata={"low": 1, "high": 65_535})
    """The port on 127.0.0.1; no other machine can reach it."""


def dash(args: list[str]) -> int:
    """Serve the page of a league until Ctrl-C."""
    what = (
        "A league as a page that follows it, in a browser of this machine: what league report writes, kept up to date."
    )
    options = parse(DashOptions, args, "dash", what)
    from dashboards.system.ports import listen
    from dashboards.web import server
    from dashboards.web.match_links import RecordedMatch
    from league.queries import page
    from league.queries.match_players import players_of
    from league.queries.query import Open
    from league.queries.recordings import RecordingQuery, chosen, load

    with options.open() as opened, listen(options.port) as listener:
        # Without a name, the page shows the league that was run last, which may change.
        def now() -> Open:
            return Open(opened.store, options.league)

        def found(number: int) -> RecordedMatch:
            match = chosen(now(), RecordingQuery(number))
            recording, _ = load(now(), match)
            return recording, players_of(now(), match, recording.header.sides)

        url = f"http://{server.HOST}:{options.port}/"
        print(f"League {opened.league}: {url} (Ctrl-C ends it; the league does not notice)", flush=True)
        try:
            server.serve(listener, lambda: page.version(now()), lambda: page.page(now(), "match/"), found)
        except KeyboardInterrupt:
            return 0
    return 0
