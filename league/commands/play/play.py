"""`league play`: an exhibition to watch, which counts for no rating."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from league.commands.options import Where, parse, place_flags, positional
from league.commands.progress_bar import report_kernels
from league.config.schema import ConfigError
from league.matches.adhoc_matches import Exhibition, Pairing, exhibition, pairing
from league.queries.query import score_text
from league.state.match_results import results_of
from matchmaking.ratings.scores import Score, score_interval
from storage.records import Match, RankedMatch

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
    others: tuple[str, ...] = positional((), many=True)
    """Those of the third and further teams."""
    episodes: int = field(default=2, metadata={"low": 1, "high": 2**20})
    """Episodes to play; where rosters allow, every other one with sides swapped."""
    record: str = field(default="1", metadata={"valid": _record})
    """Number of episodes to record, the first ones: a number, or all."""
    format: Literal["table", "json"] = "table"
    """Text for people, json for programs."""


def play(args: list[str]) -> int:
    """Play an exhibition."""
    what = (
        "Play an exhibition: it is recorded for `league watch`, and counts for no rating. Its scores are told, and in"
        " which share of the episodes each event, such as a goal or a fall, happened to whom."
    )
    options = parse(PlayOptions, args, "play", what)
    recordings = options.episodes if options.record == "all" else min(int(options.record), options.episodes)
    if recordings > MOST:
        raise ConfigError(("record",), f"--record all: {recordings} recordings are more than {MOST}; give a number")
    with options.open() as opened:
        found = pairing(opened, options.a, options.b, *options.others)
        with report_kernels():
            played = exhibition(found, options.episodes, recordings)
    matches = played.matches
    if options.format == "json":
        print(json.dumps(_as_json(found, played), indent=2))
        return 0
    print(_ranking(found, played) if found.others else _result(found, played))
    print("\n".join(_happened(played)))
    for match in matches:
        if match.recording is not None:
            print(f"  league watch {match.id} {place_flags(options.store, options.blobs)}".rstrip())
    return 0


def _result(found: Pairing, played: Exhibition) -> str:
    """Describe the result of one team or two, for A."""
    wins, draws, losses = _counts(played.matches, found.a.name)
    against = f" against {found.b.name}" if found.b else ""
    counts = f"{wins} won, {draws} drawn, {losses} lost{_voids(played.matches)}"
    measured = _measured(played, found.a.name)
    score = f" {found.a.name} scores {score_text(measured)}." if measured else ""
    return f"Exhibition of {found.a.name}{against}: {counts}.{score}"


def _ranking(found: Pairing, played: Exhibition) -> str:
    """Describe the result of three and more teams: each snapshot's score against the others, the best first."""
    names = list(dict.fromkeys(s.name for s in found.players))
    episodes = sum(match.episodes for match in played.matches)
    lines = [f"Exhibition of {', '.join(names)}: {episodes} episode{'s' * (episodes != 1)}{_voids(played.matches)}."]
    scores = {name: each for name in names if (each := _measured(played, name))}
    for name, each in sorted(scores.items(), key=lambda item: -item[1].score):
        lines.append(f"  {name} scores {score_text(each)} against the others.")
    return "\n".join(lines)


def _happened(played: Exhibition) -> list[str]:
    """Describe how long episodes took, and in which share of its episodes each event happened to a snapshot's team."""
    lines = [f"  An episode takes {played.seconds:.1f} s."] if played.seconds else []
    for name, events in played.events.items():
        if told := ", ".join(f"{event} {100 * share:.0f} %" for event, share in sorted(events.items())):
            lines.append(f"  {name}, in its episodes: {told}")
    return lines


def _as_json(found: Pairing, played: Exhibition) -> dict[str, Any]:
    """Return counts and score of each snapshot against the others, and how often events happened to its team; of games
    that are all void the score is null.
    """
    names, matches = list(dict.fromkeys(s.name for s in found.players)), played.matches
    return {
        "episodes": sum(match.episodes for match in matches),
        "voids": sum(match.voids for match in matches),
        "mean_seconds": played.seconds,
        "results": [{"name": name, **_row(played, name), "events": played.events.get(name, {})} for name in names],
        "recorded_matches": [match.id for match in matches if match.recording is not None],
    }


def _row(played: Exhibition, name: str) -> dict[str, Any]:
    wins, draws, losses = _counts(played.matches, name)
    found = _measured(played, name)
    score, low, high = (found.score, found.low, found.high) if found else (None, None, None)
    return {"wins": wins, "draws": draws, "losses": losses, "score": score, "score_low": low, "score_high": high}


def _counts(matches: Sequence[Match | RankedMatch], name: str) -> tuple[int, int, int]:
    wins, draws, losses = (sum(each) for each in zip(*(results_of(match, name) for match in matches), strict=True))
    return wins, draws, losses


def _measured(played: Exhibition, name: str) -> Score | None:
    """Return the score with its 95 % interval; None without games. Without others the episodes share no seed."""
    if name in played.scores:
        return played.scores[name]
    wins, draws, losses = _counts(played.matches, name)
    if not (games := wins + draws + losses):
        return None
    low, high = score_interval(wins, draws, losses)
    return Score((wins + draws / 2) / games, float(low), float(high), games)


def _voids(matches: Sequence[Match | RankedMatch]) -> str:
    voids = sum(match.voids for match in matches)
    return f", {voids} void" if voids else ""
