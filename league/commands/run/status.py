"""`league status`: the state of a league, its learning and paused players, its failed jobs and its workers."""

import sys
from collections.abc import Sequence

from dashboards.tables import Column, render
from dashboards.terminal import progress_bar, sparkline, styles, supports_colour
from league.commands.options import Where, parse
from league.queries.columns import PLAYERS, WORKERS
from league.queries.league_status import gather_status
from league.queries.query import Open

SCORE = Column("course", "score", no_wrap=True)
LOCKED = "The store is locked by some process, and all others wait: one that was stopped or hangs in a write?"
RECENT = 200
"""Iterations over which a terminal shows the score in training."""


def status(args: list[str]) -> int:
    """Print the status of a league."""
    options = parse(Where, args, "status", "Whether it runs, who learns, who is paused, which jobs wait or failed.")
    with options.open() as opened:
        print(report(opened, whole_errors="--debug" in sys.argv, lit=supports_colour()))
    return 0


def report(opened: Open, whole_errors: bool = False, lit: bool = False) -> str:
    """Return a league's status as text, with the first line of each error or all of it; `lit` for a terminal."""
    found = gather_status(opened, whole_errors)
    players, columns, progress = found.players, PLAYERS, []
    if lit:
        players, columns = _lit(opened, players), (*PLAYERS[:5], SCORE, *PLAYERS[5:])
        progress = [f"{name:<12} {progress_bar(share)}" for name, share in found.progress.items()]
    parts = [
        *_listed("Curriculum", found.stages),
        f"League {found.league}: {found.runs or 'stopped'}\nJobs: {found.jobs}",
        *([LOCKED] if found.runs and opened.store.locked() else []),
        render(players, columns, colour=lit),
        *_listed("Training budget", progress),
        found.share,
        *_listed("Phases", found.phases),
        *_listed("Generations", found.generations),
        *_listed("Population", found.population),
        *_listed("Paused", found.paused),
        *_listed("Tried again", found.again),
        *_listed("Set aside", found.failed),
        *_listed("Warning", [*found.voids, *opened.store.troubles()]),
        *([render(found.workers, WORKERS, colour=lit)] if found.workers else []),
        found.machine,
    ]
    return "\n\n".join(parts)


def _lit(opened: Open, players: Sequence[dict]) -> list[dict]:
    """Return players in their colours, with the score in training over their newest iterations, from 0 to 1."""
    colours, found = styles(row["player"] for row in players), []
    for row in players:
        points = opened.store.curves(opened.league, row["player"], after=row["iteration"] - RECENT)
        scores = [point.values["score"] for point in points if "score" in point.values]
        found.append({**row, SCORE.key: sparkline(scores, 0.0, 1.0), "style": colours[row["player"]]})
    return found


def _listed(title: str, lines: Sequence[str]) -> list[str]:
    return ["\n".join([f"{title}:", *(f"  {line}" for line in lines)])] if lines else []
