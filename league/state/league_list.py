"""The leagues of a store, a row each: arena, players, newest snapshot, steps, state and last activity.

Settings are read as text only, so the file of an arena of one's own may be missing.
"""

import tomllib
from typing import Any

from league.state.curriculum_stage import at_work, stages_of
from league.state.liveness import leader
from storage.records import League
from storage.store import Store


def league_rows(store: Store) -> list[dict[str, Any]]:
    """Return a row for each league of a store, oldest first.

    A curriculum has the figures of the stage that it has reached. `steps` are the environment steps of the player that
    has learnt most; `active` is in seconds since the epoch.
    """
    return [_row(store, league) for league in store.leagues()]


def _row(store: Store, league: League) -> dict[str, Any]:
    name = at_work(store, league.name)
    players, snapshots = store.players(name), store.snapshots(name, brief=True)
    checkpoints = store.newest_checkpoints(name).values()
    newest = max((s for s in snapshots if s.player), key=lambda s: (s.iteration, s.created), default=None)
    running = leader(store, league.name) is not None or leader(store, name) is not None
    number = store.last_match(name)
    matches = store.log(name, after=number - 1) if number else []
    times = [
        league.created,
        *(run.started for run in store.runs(name)),
        *(each.created for each in (*checkpoints, *snapshots, *matches)),
    ]
    stages = stages_of(league.config)
    return {
        "league": league.name,
        "arena": arena_of(league.config if name == league.name else store.league(name).config) or None,
        "stage": f"{name.removeprefix(f'{league.name}.')} of {len(stages)}" if stages and name != league.name else None,
        "players": len(players),
        "newest": None if newest is None else newest.name,
        "steps": max((each.step for each in checkpoints), default=0),
        "matches": number,
        "state": "running" if running else "stopped",
        "active": max(times),
    }  # fmt: skip


def arena_of(text: str) -> str:
    """Return the name of the arena in a league's settings; empty if they do not tell it."""
    try:
        return str(tomllib.loads(text)["arena"]["name"])
    except (ValueError, RecursionError, KeyError, TypeError):
        return ""
