"""`league rate FILE.csv`: rate results from elsewhere. `league rate --store STORE`: play, and rate what is stored."""

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from dashboards.tables import Column, render
from dashboards.text import wrapped
from league.commands.analyse import csv_log, csv_rankings
from league.commands.options import Where, parse, positional
from league.config import text_files
from league.config.durations import check_duration
from league.config.schema import ConfigError
from league.queries.ratings import unbounded_fits
from matchmaking.ratings.fit import Ratings, fit
from matchmaking.ratings.likelihoods import priors
from matchmaking.ratings.likelihoods.penalised import NotConverged
from matchmaking.ratings.likelihoods.undefeated import Unbounded
from matchmaking.ratings.separation import Separation, examined

PRIOR = 4.0
RATED = (Column("name", no_wrap=True), Column("elo", decimals=0), Column("error", "±", 0), "games")
ISLAND = Column("island")  # if there are several
UNBOUNDED = Column("unbounded", "unbounded", no_wrap=True)  # if a rating is
KEYS = ("name", "elo", "elo_stderr", "low", "high", "games", "island", "unbounded")


@dataclass(frozen=True, kw_only=True)
class RateOptions:
    """The results, and the settings of the fit; or a store, and when to stop playing."""

    file: str | None = positional(None)
    """A CSV file, - for standard input. Columns: arena,side_a,side_b,wins_a,draws,wins_b, and seed_pair if you like."""
    rankings: str | None = None
    """In place of FILE.csv: a CSV file of rankings, - for standard input. Columns: event,player,rank (equal: a tie)."""
    arena: str | None = None
    """Arena whose results to rate; needed if the file has several, whose ratings are not comparable."""
    anchor: str | None = None
    """The player that is rated 0, to whom standard errors refer (none: the mean of all players is 0)."""
    no_side: bool = False
    """Side A has no advantage to be fitted."""
    prior: float = field(default=PRIOR, metadata={"low": 0.0})
    """Virtual draws of every player with one of average strength; 0: none, and then all ratings must be finite."""
    format: Literal["table", "json", "csv"] = "table"
    """table for people, json or csv for programs."""
    store: str | None = None
    """In place of a file: a store, a folder or URL, whose snapshots play rating matches in this process, untrained."""
    league: str | None = None
    """With --store: the league's name (none: the one that was run last)."""
    blobs: str | None = None
    """With --store: place of its policies and recordings, as for other commands."""
    among: tuple[str, ...] = ()
    """With --store: the snapshots to play, such as strong,blue@64, beside the initial ones (none: all)."""
    budget: str = field(default="10m", metadata={"valid": check_duration})
    """With --store: time to play, such as 90s or 1h; the batch under way is finished."""
    episodes: int | None = field(default=None, metadata={"low": 1})
    """With --store: number of episodes after which to stop, in whole batches of 512 on a CPU (none: no limit)."""
    width: float | None = field(default=None, metadata={"above": 0.0})
    """With --store: stop when no 95 % interval is wider, in Elo (none: play on)."""


LOG_ONLY = ("arena", "no_side")
FILE_ONLY, STORE_ONLY = (
    (*LOG_ONLY, "anchor", "prior", "format"),
    ("league", "blobs", "among", "budget", "episodes", "width"),
)


def rate(args: list[str]) -> int:
    """Rate a match log."""
    what = (
        "Rate a match log of your own: Bradley-Terry with draws and a side advantage, on the Elo scale. Or rate"
        " rankings of any number of players (Plackett-Luce with ties), or the snapshots of a store by matches played"
        " now, without training."
    )
    options = parse(RateOptions, args, "rate", what)
    _check_source(options)
    if options.store is not None:
        from league.commands.analyse.rate_store import rate_store

        with Where(options.store, options.league, options.blobs).open() as opened:
            return rate_store(opened, options.among, options.budget, options.episodes, options.width)
    source, log = _log(options)
    found = examined(log.payoff, not options.no_side)
    ratings = _fitted(log, found, options, source)
    without = "" if options.no_side or log.payoff.rankings else "--no-side"
    warnings = unbounded_fits.warnings(found, log.payoff, "side A", _held(options), without, own=True)
    print(_report(ratings, log, options, found, warnings))
    if options.format == "csv":
        for warning in warnings:
            print(f"league: {warning}", file=sys.stderr)
    return 0


def _log(options: RateOptions) -> tuple[str, csv_log.Log]:
    """Return the name of the file in messages, and its games. Raises ConfigError."""
    if options.rankings is not None:
        return text_files.STDIN if options.rankings == "-" else options.rankings, csv_rankings.read(options.rankings)
    assert options.file is not None
    source = text_files.STDIN if options.file == "-" else options.file
    arena = None if options.arena is None else text_files.composed(options.arena)
    return source, csv_log.sums(csv_log.choose(csv_log.read(options.file), arena, source))


def _check_source(options: RateOptions) -> None:
    """Raise ConfigError unless one file or a store is given, with flags for it alone."""
    given = sum(source is not None for source in (options.file, options.rankings, options.store))
    if given != 1:
        found = f"{('none', '', 'two', 'three')[given]} {'is' if not given else 'are'} given"
        takes = "league rate takes FILE.csv, --rankings FILE.csv or --store STORE"
        raise ConfigError((), f"{takes}, and {found}: see league rate --help")
    wrong, of = (FILE_ONLY, "FILE.csv") if options.store is not None else (STORE_ONLY, "--store")
    if options.rankings is not None:
        wrong, of = (*STORE_ONLY, *LOG_ONLY), "FILE.csv without --rankings, or for --store"
    default = RateOptions(file=None)
    for name in wrong:
        if getattr(options, name) != getattr(default, name):
            raise ConfigError((name,), f"--{name.replace('_', '-')} is for league rate {of}: leave it out")


def _fitted(log: csv_log.Log, found: Separation, options: RateOptions, source: str) -> Ratings:
    """Fit the ratings, which are comparable only within each island. Raises ConfigError."""
    anchor = None if options.anchor is None else text_files.composed(options.anchor)
    anchors = [] if anchor is None else [csv_log.known(anchor, log.payoff.names, source)]
    prior = priors.average(options.prior) if options.prior else priors.none()
    islands = {name: str(number) for name, number in zip(log.payoff.names, found.island.tolist(), strict=True)}
    try:
        return fit(
            log.payoff, prior=prior, anchors=anchors, anchor_elo=0.0, sides=not options.no_side, clusters=log.clusters,
            populations=islands if found.islands > 1 else None,
        )  # fmt: skip
    except Unbounded as error:
        cure = "give --prior above 0"
        if found.side and examined(log.payoff, False).finite:
            cure = "use --no-side if the log names the winner first"
        raise ConfigError(
            ("prior",), f"{source}: {error}; that has no finite rating without a prior: {cure}"
        ) from error
    except NotConverged as error:  # floating-point numbers do not resolve billions of games beside a few
        raise ConfigError(
            ("prior",), f"{source}: counts are too unlike for the fit to converge: give a larger --prior"
        ) from error


def _held(options: RateOptions) -> str:
    return f"the prior (--prior {options.prior:g})" if options.prior else ""


def rows(ratings: Ratings, found: Separation) -> list[dict[str, Any]]:
    """Return a row per player, best first in its island: name, elo, elo_stderr, low and high (95 %), games, island.

    `unbounded` is the direction in which the games alone do not bound a rating: above, below or both. A rating that
    they do not determine at all is None.
    """
    columns = (ratings.elo, ratings.stderr, ratings.low, ratings.high)
    known = [[None if dark else x for x, dark in zip(each.tolist(), found.unknown, strict=True)] for each in columns]
    of = zip(ratings.names, *known, ratings.games.tolist(), found.island.tolist(), found.ratings, strict=True)
    rows: list[dict[str, Any]] = [dict(zip(KEYS, row, strict=True)) for row in of]
    return sorted(rows, key=lambda row: (row["island"], row["elo"] is None, -(row["elo"] or 0), row["name"]))


def summary(ratings: Ratings, found: Separation, warnings: Sequence[str] = ()) -> dict[str, Any]:
    """Return the fit as an object for JSON; the fit of rankings has the tie terms δ by number of tied players.

    None stands for a side advantage that was not fitted, for draws if there were none, and for values that are not
    finite.
    """
    sided = not math.isnan(ratings.side_stderr) and not found.side
    return {
        "ratings": rows(ratings, found),
        "side_elo": ratings.side_advantage if sided else None,
        "side_elo_stderr": ratings.side_stderr if sided else None,
        "draw": None if found.draw else ratings.draw or None,
        "log_likelihood": ratings.log_likelihood,
        "islands": found.islands,
        "unbounded": unbounded_fits.as_object(found, ratings.names),
        "warnings": list(warnings),
        **({"ties": ratings.ties} if ratings.ties and not found.draw else {}),
    }


def _report(
    ratings: Ratings, log: csv_log.Log, options: RateOptions, found: Separation, warnings: Sequence[str]
) -> str:
    if options.format == "json":
        return json.dumps(summary(ratings, found, warnings), indent=2)
    if options.format == "csv":
        return render(rows(ratings, found), (), "csv")
    table = [
        {**row, "error": None if row["elo"] is None else (row["high"] - row["low"]) / 2} for row in rows(ratings, found)
    ]
    where = f" in {log.payoff.arena.arena}" if log.payoff.arena else ""
    notes = "\n".join(map(wrapped, _notes(ratings, log, options, found)))
    shown = [*RATED, *([ISLAND] if found.islands > 1 else []), *([UNBOUNDED] if any(found.ratings) else [])]
    above = [*map(wrapped, warnings), ""] if warnings else []
    return "\n".join([wrapped(f"Elo with 95 % intervals{where}"), "", *above, render(table, shown), "", notes])


def _notes(ratings: Ratings, log: csv_log.Log, options: RateOptions, found: Separation) -> list[str]:
    """Explain the figures, with one or two sentences for each."""
    of = "all players" if found.islands == 1 else "each island"
    gauge = f"{options.anchor} is 0" if options.anchor is not None else f"The mean of {of} is 0"
    if options.anchor is not None and found.islands > 1:
        gauge += ", and the mean of each other island"
    notes = [f"{gauge}; ± is of the difference to that."]
    if options.prior:
        notes.append(f"Every player has {options.prior:g} virtual draws with one of average strength (--prior).")
    if found.side:
        notes.append("What side A is worth is not known, see above.")
    elif not math.isnan(error := ratings.side_stderr):
        notes.append(f"Side A is worth {round(ratings.side_advantage) or 0:+d} Elo (standard error {error:.0f}).")
    elif not options.no_side and not log.payoff.rankings:
        notes.append("What side A is worth cannot be told from strength: sides did not change.")
    if found.draw:
        notes.append("How often equals draw is not known, see above.")
    elif ratings.draw:
        share = 100 * ratings.draw / (2 + ratings.draw)
        what = "rankings of two are ties" if ratings.ties else "games are drawn"
        notes.append(f"Between equals {share:.1f} % of the {what} (Davidson's ν {ratings.draw:.3g}).")
    if clustered := int(log.clusters.number.sum()):
        pairs = f"{clustered:,} seed pairs" if clustered > 1 else "one seed pair"
        notes.append(f"The games of {pairs} count pair by pair in the intervals.")
    return notes
