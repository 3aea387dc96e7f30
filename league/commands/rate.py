"""`league rate FILE.csv`: the league's fit for results that were played elsewhere."""

import json
import math
from dataclasses import dataclass, field
from typing import Any, Literal

from dashboards.tables import Column, render
from league import results
from league.commands.options import parse, positional
from league.config.schema import ConfigError
from league.words import wrapped
from matchmaking import priors
from matchmaking.bounds import Unbounded
from matchmaking.likelihood import NotConverged
from matchmaking.ratings import Ratings, fit

PRIOR = 4.0
RATED = (Column("name", whole=True), Column("elo", decimals=0), Column("error", "±", 0), "games")


@dataclass(frozen=True, kw_only=True)
class RateOptions:
    """Whose results, and how to rate them."""

    file: str = positional()
    """A CSV file, - for standard input. Columns: arena,side_a,side_b,wins_a,draws,wins_b, and seed_pair if you like."""
    arena: str | None = None
    """Which arena's results to rate; needed where the file has several, whose ratings are not comparable."""
    anchor: str | None = None
    """The player that is rated 0, to whom standard errors refer (none: the mean of all players is 0)."""
    no_side: bool = False
    """Side A has no advantage to be fitted."""
    prior: float = field(default=PRIOR, metadata={"low": 0.0})
    """Virtual draws of every player with one of average strength; 0: none, and then all ratings must be finite."""
    format: Literal["table", "json", "csv"] = "table"
    """table for people, json or csv for programs."""


def rate(args: list[str]) -> int:
    """Rate a match log."""
    what = "Rate a match log of your own: Bradley-Terry with draws and a side advantage, on the Elo scale."
    options = parse(RateOptions, args, "rate", what)
    source = "standard input" if options.file == "-" else options.file
    log = results.sums(results.choose(results.read(options.file), options.arena, source))
    anchors = [results.known(options.anchor, log.payoff.names, source)] if options.anchor is not None else []
    prior = priors.average(options.prior) if options.prior else priors.none()
    try:
        ratings = fit(
            log.payoff, prior=prior, anchors=anchors, anchor_elo=0.0, sides=not options.no_side, clusters=log.clusters
        )
    except Unbounded as error:
        raise ConfigError(
            ("prior",), f"{source}: {error}; that has no finite rating without a prior: give --prior above 0"
        ) from error
    except NotConverged as error:  # billions of games beside a handful are more than floating-point numbers resolve
        raise ConfigError(
            ("prior",), f"{source}: counts are too unlike for the fit to converge: give a larger --prior"
        ) from error
    print(_told(ratings, log, options))
    return 0


def rows(ratings: Ratings) -> list[dict[str, Any]]:
    """A row per player, best first: name, elo, elo_stderr, low and high (95 %), games."""
    found = [
        {"name": name, "elo": elo, "elo_stderr": stderr, "low": low, "high": high, "games": games}
        for name, elo, stderr, low, high, games in zip(
            ratings.names, *(each.tolist() for each in (ratings.elo, ratings.stderr, ratings.low, ratings.high)),
            ratings.games.tolist(), strict=True,
        )
    ]  # fmt: skip
    return sorted(found, key=lambda row: (-row["elo"], row["name"]))


def summary(ratings: Ratings) -> dict[str, Any]:
    """The fit as an object; a side that was not fitted and draws that there were not are None."""
    sided = not math.isnan(ratings.side_stderr)
    return {
        "ratings": rows(ratings),
        "side_elo": ratings.side_advantage if sided else None,
        "side_elo_stderr": ratings.side_stderr if sided else None,
        "draw": ratings.draw or None,
        "log_likelihood": ratings.log_likelihood,
    }


def _told(ratings: Ratings, log: results.Log, options: RateOptions) -> str:
    if options.format == "json":
        return json.dumps(summary(ratings), indent=2, ensure_ascii=False)
    if options.format == "csv":
        return render(rows(ratings), (), "csv")
    table = [{**row, "error": (row["high"] - row["low"]) / 2} for row in rows(ratings)]
    arena = log.payoff.arena.arena if log.payoff.arena else ""
    notes = "\n".join(map(wrapped, _notes(ratings, log, options)))
    return "\n".join([wrapped(f"Elo with 95 % intervals in {arena}"), "", render(table, RATED), "", notes])


def _notes(ratings: Ratings, log: results.Log, options: RateOptions) -> list[str]:
    """What the figures mean, a sentence or two for each."""
    gauge = f"{options.anchor} is 0" if options.anchor is not None else "The mean of all players is 0"
    notes = [f"{gauge}; ± is of the difference to that."]
    if options.prior:
        notes.append(f"Every player has {options.prior:g} virtual draws with one of average strength (--prior).")
    if not math.isnan(error := ratings.side_stderr):
        notes.append(f"Side A is worth {ratings.side_advantage:+.0f} Elo (standard error {error:.0f}).")
    elif not options.no_side:
        notes.append("What side A is worth cannot be told from strength: sides did not change.")
    if ratings.draw:
        share = 100 * ratings.draw / (2 + ratings.draw)
        notes.append(f"Between equals {share:.1f} % of the games are drawn (Davidson's ν {ratings.draw:.3g}).")
    if clustered := int(log.clusters.number.sum()):
        pairs = f"{clustered:,} seed pairs" if clustered > 1 else "one seed pair"
        notes.append(f"The games of {pairs} count pair by pair in the intervals.")
    return notes
