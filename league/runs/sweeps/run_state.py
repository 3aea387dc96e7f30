"""The progress of a league that a configuration describes: what is left to do, and what was set otherwise."""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Literal

from league.config import experiment
from league.config.experiment import Config
from league.scheduling import curriculum
from league.scheduling.episode_lengths import averaged_iterations
from league.scheduling.match_scheduler import rating_goes_on
from league.scheduling.training_progress import trained_enough
from league.state.jobs import TrainingTurn
from league.state.league_state import LeagueState
from league.state.liveness import leader
from storage.store import Store

RunState = Literal["waits", "begun", "runs", "finished"]
MAY_CHANGE = ("budget", "workers", "storage", "rating", "league", "seed")
"""Tables of settings that may change while a league is run on: they do not change what is learnt in a step."""


def run_state(store: Store, config: Config) -> RunState:
    """Return whether a league waits, was begun, runs, or has had its budget."""
    there = {league.name for league in store.leagues()}
    if config.league not in there:
        return "waits"
    stages = [experiment.stage(config, number) for number in range(len(config.stages))]
    if any(leader(store, each.league) for each in (config, *stages) if each.league in there):
        return "runs"
    last = stages[-1] if stages else config
    return "finished" if last.league in there and is_finished(store, last, bool(stages)) else "begun"


def is_finished(store: Store, config: Config, is_stage: bool = False) -> bool:
    """Return whether a league, or the last stage of a curriculum, has had its budget and its ratings."""
    state = with_retries(LeagueState.of(store, config.league, recent=averaged_iterations(config)))
    ended = curriculum.ended(config, state) is not None if is_stage else trained_enough(config, state)
    return ended and not rating_goes_on(config, state)


def with_retries(state: LeagueState) -> LeagueState:
    """Return the state as the manager will find it: when a person runs the league, failed turns are tried again."""
    kept = [job for job in state.jobs if (job.kind, job.state) != (TrainingTurn.kind, "failed")]
    return replace(state, jobs=kept)


def other_settings(store: Store, config: Config) -> list[str]:
    """Return the settings, by dotted key, in which a league of the store learnt otherwise than `config` says."""
    kept = next((league.config for league in store.leagues() if league.name == config.league), None)
    if kept is None:
        return []
    before, now = flat_settings(kept), flat_settings(experiment.dumps(config))
    differ = [key for key in {**before, **now} if before.get(key) != now.get(key)]
    return [key for key in differ if key.partition(".")[0] not in MAY_CHANGE]


def begun_otherwise(store: Store, config: Config) -> str:
    """Return a line about a league that learnt otherwise than `config` says; empty for any other."""
    if not (other := other_settings(store, config)):
        return ""
    what = f"{', '.join(other[:3])}{', ...' if len(other) > 3 else ''}"
    return f"it was begun with another {what}: give the sweep another name, or remove the league"


def flat_settings(text: str) -> dict[str, Any]:
    """Return a league's settings by dotted key; empty for invalid text."""
    try:
        return dict(_flat(tomllib.loads(text)))
    except (ValueError, RecursionError):
        return {}


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
