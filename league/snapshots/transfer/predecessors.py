"""Predecessors: players, settings and networks of the leagues, snapshots and frozen policies that `after` names.

A frozen policy, which comes with the league or is a file that `league export` wrote, counts as a league of one player,
and so does a snapshot, which is named league/snapshot.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from agents.policy.skill_arrays import PREFIX, strategy_of
from arenas.rosters import roster_agents
from league.config.sections import POLICY_FILE, Rating
from league.queries.league_settings import LeagueSettings
from league.scheduling.training_progress import handed_on
from league.snapshots import policy_file
from league.snapshots.transfer.home_arena import HomeTeam, home_team
from league.state.league_state import LeagueState
from storage.blobs import arrays, programs
from storage.errors import StorageError, UnknownName
from storage.records import Player, Snapshot
from storage.store import Store

FROZEN = "frozen"  # the role of a policy that comes with the league, or from a file


def forerunners(store: Store | None, named: Sequence[str]) -> list[Sequence[Player]]:
    """Return the players for each name: of a league of the store, of a snapshot, of a policy that comes with the
    league, or of a file.

    Raises UnknownName for a name that is none of them, StorageError for a snapshot without networks, ExchangeError for
    a file without a policy.
    """
    leagues = {league.name: store for league in store.leagues()} if store else {}
    for name in named:
        if name.partition("/")[0] not in leagues and not _is_policy(name):
            raise UnknownName("league or trained policy", name, [*leagues, *policy_file.trained()])
    found: list[Sequence[Player]] = []
    for name in named:
        league, slash, _ = name.partition("/")
        if _is_policy(name) and name not in leagues:
            found.append([_player_of(name)])
        elif slash:
            snapshot = _snapshot(leagues[league], name)
            found.append([Player(name, snapshot.name, 0, FROZEN, snapshot.roster)])
        else:
            found.append(leagues[name].players(name))
    return found


def _snapshot(store: Store, name: str) -> Snapshot:
    """Return the snapshot that is named league/snapshot. Raises UnknownName, or StorageError if it has no networks."""
    league, _, own = name.partition("/")
    known = {snapshot.name: snapshot for snapshot in store.snapshots(league)}
    if own not in known:
        raise UnknownName("snapshot", own, [*known])
    snapshot = known[own]
    if snapshot.thinned is not None:
        raise StorageError(f"{name} has been thinned: its policy is gone")
    if snapshot.script or programs.is_program(store.blobs.get(snapshot.digest)):
        raise StorageError(f"{name} is a {'script' if snapshot.script else 'program'}: no player can go on from it")
    return snapshot


def _is_policy(name: str) -> bool:
    """Return whether the name is that of a policy that comes with the league, or a file's."""
    return name in policy_file.trained() or name.endswith(POLICY_FILE)


def _player_of(name: str) -> Player:
    """Return the player of a policy that comes with the league or is in a file. Raises ExchangeError."""
    about = policy_file.read(policy_file.find(name)).about
    return Player(name, about["name"], 0, FROZEN, about["roster"])


def settings_of(store: Store | None, name: str) -> str:
    """Return the settings, as TOML, with which a league, a snapshot's league or a frozen policy learnt."""
    if _is_policy(name) and (store is None or name not in {league.name for league in store.leagues()}):
        return str(policy_file.read(policy_file.find(name)).about["settings"])
    assert store is not None  # `forerunners` knows no league of a store that is not there
    return store.league(name.partition("/")[0]).config


def home_of(store: Store | None, league: str, player: str) -> HomeTeam:
    """Return the team for which a player named in `after` learnt. Its arena is built: seconds.

    Raises ValueError as `home_team` does, and StorageError as `forerunners` does.
    """
    (players,) = forerunners(store, [league])
    roster = next(each.roster for each in players if each.name == player)
    return home_team(settings_of(store, league), roster)


def state_of(store: Store | None, league: str, player: str) -> tuple[str, Mapping[str, np.ndarray]]:
    """Return the name of a source player and its learner's state; for a frozen policy only the part for actors."""
    known = {each.name for each in store.leagues()} if store is not None else set()
    if league not in known and _is_policy(league):
        return f"{Path(league).stem}/{player}", _arrays_of(policy_file.read(policy_file.find(league)))
    assert store is not None  # `forerunners` knows no league of a store that is not there
    if "/" in league:
        snapshot = _snapshot(store, league)
        state = actors_of(arrays.from_bytes(store.blobs.get(snapshot.digest)))
        return league, _with_counts(state, snapshot.roster, snapshot.step)
    kept = store.checkpoint(league, player)
    if kept is None:
        raise StorageError(f"player {player} of league {league} has no checkpoint to start from")
    state = strategy_of(arrays.from_bytes(store.blobs.get(kept.digest)))  # its skills are not taken over
    if found := best_of(store, league, player):
        snapshot, _ = found
        return f"{league}/{snapshot.name}", {**state, **actors_of(arrays.from_bytes(store.blobs.get(snapshot.digest)))}
    return f"{league}/{player}@{kept.iteration}", state


def best_of(store: Store, league: str, player: str) -> tuple[Snapshot, str] | None:
    """Return the snapshot to start from for a player of a league, and its score in words; None: use the newest state.

    The critic is always the newest one, because snapshots have none.
    """
    if league not in {known.name for known in store.leagues()}:
        return None
    settings = LeagueSettings(league, store.league(league).config)
    quota = settings.get("rating", "episodes_per_pair", otherwise=Rating().episodes_per_pair)
    against = settings.get("budget", "against", otherwise=[])
    found = handed_on(LeagueState.of(store, league), player, quota, against)
    return None if found is None else (found.snapshot, found.in_words)


def actors_of(policies: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a snapshot's arrays by their names in a learner's state, which has no skills."""
    learnt = {name: array for name, array in policies.items() if not name.partition("/")[2].startswith(PREFIX)}
    return {f"actor.{name.replace('/', '.', 1)}": array for name, array in learnt.items()}


def _arrays_of(policy: policy_file.Policy) -> dict[str, np.ndarray]:
    """Return a frozen policy's actors as in a learner's state."""
    return _with_counts(actors_of(policy.arrays), policy.about["roster"], policy.about["steps"])


def _with_counts(state: dict[str, np.ndarray], roster: str, steps: int) -> dict[str, np.ndarray]:
    """Return the actors of a frozen policy that learnt from so many decisions, with the weight of its statistics.

    If the policy normalises observations, its statistics have the weight of these decisions, so that a first batch does
    not dominate them. They weigh at least one: the first snapshot of a later stage has learnt from none, and without a
    weight its networks would not be kept as they are when the statistics move.
    """
    for i in range(len(roster_agents(roster))):
        trunk = f"actor.{i}.trunk.observation_"
        known = max(1, steps) if np.isfinite(state[f"{trunk}clip"]) else 0
        state[f"actor.{i}.observed"] = np.full_like(state[f"{trunk}mean"], known)
    return state
