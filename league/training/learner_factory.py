"""Construction of players' learners and of their batches, from the league's settings and the players' own."""

from collections.abc import Mapping
from dataclasses import replace
from zlib import crc32

import numpy as np

from agents.batch import Batch
from agents.bridge import CriticMemories, common_critic_size, team_batch
from agents.devices.distributed import SINGLE_PROCESS, Communicator
from agents.learner import checkpoint
from agents.learner.happo import Learner
from agents.rollout.rollout import Trajectory
from agents.settings import HappoConfig
from arenas.arena import Arena
from arenas.state import TeamSpec
from league.config.experiment import Config
from league.config.sections import named_players
from league.snapshots import warm_start
from storage.records import Player, Snapshot
from storage.store import Store


def settings_of(config: Config, player: Player) -> HappoConfig:
    """Return a player's settings: the league's, with the changes of its entry in `players`."""
    settings = config.learner
    for own in (entry for entry in named_players(config.players) if entry.name == player.name):
        if own.hidden is not None:
            settings = replace(settings, architecture=replace(settings.architecture, hidden=own.hidden))
        if own.lr is not None:
            settings = replace(settings, lr=own.lr, critic_lr=own.lr)
    return settings


def new_learner(
    config: Config,
    arena: Arena,
    player: Player,
    comm: Communicator = SINGLE_PROCESS,
    moved: Mapping[str, float] | None = None,
) -> Learner:
    """Make a player's learner with its own seed and settings, and with the hyperparameters that have `moved`."""
    agents = arena.teams[player.team].agents
    settings = replace(settings_of(config, player), **(moved or {}))
    seed = crc32(f"{config.seed}/{player.name}".encode())
    sizes = [a.observation_size for a in agents], [a.action_size for a in agents]
    other_sizes = [a.observation_size for team in others(config, arena, player.team) for a in team.agents]
    kinds, sees = [a.kind for a in agents], settings.critic_input
    critic_size = {"privileged": sum(sizes[0]) + arena.privileged_size, "same": common_critic_size(arena.teams)}.get(
        sees, 0
    )
    return Learner(*sizes, settings, seed, config.training.device, kinds, other_sizes, critic_size, comm)


def reset_learner(
    learner: Learner, config: Config, arena: Arena, player: Player, store: Store, source: Snapshot, iteration: int,
    comm: Communicator = SINGLE_PROCESS,
) -> None:  # fmt: skip
    """Reset a player's learner to the actors of a snapshot and an otherwise initial state with a new random seed.

    The normalisation statistics of observations count as many decisions as the snapshot has learnt from. The first
    policy of a league that follows another one brings its statistics along, which keep their present count.
    """
    fresh = new_learner(config, arena, player, comm)
    known = checkpoint.observed(learner.state())
    if not (source.initial and config.after):
        known = {name: np.full_like(counts, source.step) for name, counts in known.items()}
    warm_start.thaw_into(fresh, store.blobs.get(source.digest), known)
    learner.load(fresh.state())
    learner.rng.manual_seed(crc32(f"{config.seed}/{player.name}/{iteration}".encode()))


def batch_of(
    config: Config, arena: Arena, player: Player, trajectory: Trajectory, worlds: slice | np.ndarray = slice(None),
    shaping: float = 0.0, critic_memories: CriticMemories = (),
) -> Batch:  # fmt: skip
    """Return a player's part of a trajectory with the critic input that the settings choose; see `team_batch`."""
    sees = config.learner.critic_input
    return team_batch(
        trajectory, arena.teams[player.team], player.team, worlds, shaping,
        others=others(config, arena, player.team), privileged=sees == "privileged",
        common=arena.teams if sees == "same" else (), critic_memories=critic_memories,
    )  # fmt: skip


def others(config: Config, arena: Arena, team: int) -> list[TeamSpec]:
    """Return the teams whose observations a team's critic sees beside its own."""
    return [t for i, t in enumerate(arena.teams) if i != team and config.learner.critic_input == "all"]
