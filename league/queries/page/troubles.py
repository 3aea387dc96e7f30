"""Troubles of a league, a line for each: the overview's list."""

from collections.abc import Sequence

from league.queries.league_status import LeagueStatus
from league.queries.query import Open
from league.queries.ratings.rating_rows import Row
from league.state.league_state import LeagueState
from league.state.liveness import STARTING, processes


def troubles(opened: Open, state: LeagueState, status: LeagueStatus, rows: Sequence[Row]) -> list[str]:
    """Return a line for each thing that is wrong, the gravest first; empty if the league knows of none.

    `rows` are those of the ladder.
    """
    return [
        *_of_processes(opened, state, status),
        *(f"Paused, it learns no more: {_first(text)}" for text in status.paused),
        *(f"Set aside: {_first(text)}" for text in status.failed),
        *(
            f"{p.name} met numbers that are not finite and went back to its last checkpoint."
            for p in state.players
            if p.setbacks and p.paused is None
        ),
        *(f"Tried again: {_first(text)}" for text in status.again),
        *(f"{each.short[0].upper()}{each.short[1:]}: section Players has the cause." for each in state.voids),
        *_of_ratings(state, rows),
    ]


def _of_processes(opened: Open, state: LeagueState, status: LeagueStatus) -> list[str]:
    """Return lines on workers that ended without a word in the last minutes, and on a league without a trainer."""
    alive = {worker.id for worker in processes(opened.store, opened.league)}
    gone = [w for w in opened.store.workers(opened.league, STARTING) if w.id not in alive]
    lines = [f"{worker.id} ({worker.kinds}) stopped without a word." for worker in gone]
    if status.runs and not any(worker["doing"] for worker in status.workers):
        lines.append("The league runs, and no worker does anything yet.")
    return lines


def _of_ratings(state: LeagueState, rows: Sequence[Row]) -> list[str]:
    learnt = any(at.iteration for at in state.checkpoints.values())
    lines = [] if not learnt or any(row["rank"] for row in rows) else ["No snapshot has a known rating yet."]
    flagged = [row["name"] for row in rows if row["flagged"] == "!"]
    if flagged:
        more = f" and {len(flagged) - 2} others" if len(flagged) > 2 else ""
        lines.append(f"Robots of {', '.join(flagged[:2])}{more} make too many episodes void.")
    return lines


def _first(text: str) -> str:
    return text.strip().splitlines()[0]
