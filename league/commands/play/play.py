"""`league play`: an exhibition to watch, which counts for no rating."""

from dataclasses import dataclass, field

from league.commands.options import Where, parse, positional
from league.commands.progress_bar import report_kernels
from league.config.schema import ConfigError
from league.matches.adhoc_matches import exhibition, pairing
from league.queries.query import score_text
from matchmaking.ratings.payoff import Score, score_interval

MOST = 100
"""Most recordings of an exhibition: each takes some hundred kilobytes, and its frames stay in memory until written."""


def _record(value: str) -> None:
    if value != "all" and not (value.isdecimal() and int(value) <= MOST):
        raise ValueError(f"must be all, or a number up to {MOST}")


@dataclass(frozen=True, kw_only=True)
class PlayOptions(Where):
    """The players, the number of episodes, and the number of recordings."""

    a: str = positional()
    """A snapshot, such as blue@64 or pusher, or a player, whose newest it is: `league snapshots` lists them."""
    b: str | None = positional(None)
    """Another one; left out in an arena of one team."""
    episodes: int = field(default=2, metadata={"low": 1, "high": 2**20})
    """Episodes to play; where rosters allow, every other one with sides swapped."""
    record: str = field(default="1", metadata={"valid": _record})
    """Number of episodes to record, the first ones: a number, or all."""


def play(args: list[str]) -> int:
    """Play an exhibition."""
    what = "Play an exhibition: it is recorded for `league watch`, and counts for no rating."
    options = parse(PlayOptions, args, "play", what)
    recordings = options.episodes if options.record == "all" else min(int(options.record), options.episodes)
    if recordings > MOST:
        raise ConfigError(("record",), f"--record all: {recordings} recordings are more than {MOST}; give a number")
    with options.open() as opened:
        found = pairing(opened, options.a, options.b)
        with report_kernels():
            matches = exhibition(found, options.episodes, recordings)
    wins, draws, losses, voids = (sum(getattr(m, n) for m in matches) for n in ("wins", "draws", "losses", "voids"))
    games, text = wins + draws + losses, ""
    if games:
        low, high = score_interval(wins, draws, losses)
        text = score_text(Score((wins + draws / 2) / games, float(low), float(high), games))
        text = f" {found.a.name} scores {text}."
    against = f" against {found.b.name}" if found.b else ""
    counts = f"{wins} won, {draws} drawn, {losses} lost" + (f", {voids} void" if voids else "")
    print(f"Exhibition of {found.a.name}{against}: {counts}.{text}")
    for match in matches:
        if match.recording is not None:
            print(f"  league watch {match.id}")
    return 0
