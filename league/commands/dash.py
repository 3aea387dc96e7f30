"""`league dash`: a league as a page in a browser of this machine, which follows it."""

from dataclasses import dataclass, field

from league.commands.options import Where, parse

PORT = 8710


@dataclass(frozen=True)
class DashOptions(Where):
    """Which league, and where to serve it."""

    port: int = field(default=PORT, metadata={"low": 1, "high": 65_535})
    """The port on 127.0.0.1; no other machine can reach it."""


def dash(args: list[str]) -> int:
    """Serve the page of a league until Ctrl-C."""
    what = (
        "A league as a page that follows it, in a browser of this machine: what league report writes, kept up to date."
    )
    options = parse(DashOptions, args, "dash", what)
    from dashboards import server
    from dashboards.matches import Found
    from league import overview
    from league.cast import cast
    from league.query import Open
    from league.recorded import Wish, chosen, load

    with options.open() as opened, server.bound(options.port) as listener:
        # Without a name it is the league that was run last, which another one may become.
        def now() -> Open:
            return Open(opened.store, options.league)

        def found(number: int) -> Found:
            match = chosen(now(), Wish(number))
            recording, _ = load(now(), match)
            return recording, cast(now(), match, recording.header.sides)

        url = f"http://{server.HOST}:{options.port}/"
        print(f"League {opened.league}: {url} (Ctrl-C ends it; the league does not notice)", flush=True)
        try:
            server.serve(listener, lambda: overview.version(now()), lambda: overview.page(now(), "match/"), found)
        except KeyboardInterrupt:
            return 0
    return 0
