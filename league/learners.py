"""Players' learners: made, and given what to learn from, as the league's settings and their own have them."""

from collections.abc import Mapping
from dataclasses import replace
from zlib import crc32

import numpy as np

from agents import checkpoint
from agents.batch import Batch
from agents.bridge import Recalled, common_size, team_batch
from agents.happo import Learner
from agents.parallel import ALONE, Together
from agents.rollout import Trajectory
from agents.settings import HappoConfig
from arenas.arena import Arena
from arenas.state import TeamSpec
from league import heirs
from league.config.experiment import Config
from league.config.sections import named_players
from storage.records import Player, Snapshot
from storage.store import Store


def settings_of(config: Config, player: Player) -> HappoConfig:
    """A player's settings: the league's, and what its entry in `players` changes."""
    settings = config.learner
    for own in (entry for entry in named_players(config.players) if entry.name == player.name):
        if own.hidden is not None:
            settings = replace(settings, architecture=replace(settings.architecture, hidden=own.hidden))
        if own.lr is not None:
            settings = replace(settings, lr=own.lr, critic_lr=own.lr)
    return settings


def new_learner(
    config: Config, arena: Arena, player: Player, together: Together = ALONE, moved: Mapping[str, float] | None = None
) -> Learner:
    """A player's learner with what is its own: its seed, its settings, and the hyperparameters that have moved."""
    agents = arena.teams[player.team].agents
    settings = replace(settings_of(config, player), **(moved or {}))
    seed = crc32(f"{config.seed}/{player.name}".encode())
    sizes = [a.observation_size for a in agents], [a.action_size for a in agents]
    theirs = [a.observation_size for team in others(config, arena, player.team) for a in team.agents]
    kinds, sees = [a.kind for a in agents], settings.critic_input
    sight = {"privileged": sum(sizes[0]) + arena.privileged_size, "same": common_size(arena.teams)}.get(sees, 0)
    return Learner(*sizes, settings, seed, config.training.device, kinds, theirs, sight, together)


def begin_anew(
    learner: Learner, config: Config, arena: Arena, player: Player, store: Store, source: Snapshot, iteration: int,
    together: Together = ALONE,
) -> None:  # fmt: skip
    """Have a player's learner go on from the actors of a snapshot, with all else as at its beginning, but other dice.

    What is known of observations is worth as many decisions as the snapshot has learnt from; a first policy that came
    from another league brings it along, and there it is worth as many as now.
    """
    fresh = new_learner(config, arena, player, together)
    known = checkpoint.observed(learner.state())
    if not (source.initial and config.after):
        known = {name: np.full_like(counts, source.step) for name, counts in known.items()}
    heirs.thaw_into(fresh, store.blobs.get(source.digest), known)
    learner.load(fresh.state())
    learner.rng.manual_seed(crc32(f"{config.seed}/{player.name}/{iteration}".encode()))


def batch_of(
    config: Config, arena: Arena, player: Player, trajectory: Trajectory, worlds: slice | np.ndarray = slice(None),
    shaping: float = 0.0, recalled: Recalled = (),
) -> Batch:  # fmt: skip
    """A player's part of a trajectory with what its critic sees, as the settings have that; see `team_batch`."""
    sees = config.learner.critic_input
    return team_batch(
        trajectory, arena.teams[player.team], player.team, worlds, shaping,
        others=others(config, arena, player.team), privileged=sees == "privileged",
        common=arena.teams if sees == "same" else (), recalled=recalled,
    )  # fmt: skip


def others(config: Config, arena: Arena, team: int) -> list[TeamSpec]:
    """The teams whose observations a team's critic sees beside its own."""
    return [t for i, t in enumerate(arena.teams) if i != team and config.learner.critic_input == "all"]
