"""Construction of players' learners and of their batches, from the league's settings and the players' own."""

from collections.abc import Mapping
from dataclasses import replace
from zlib import crc32

import numpy as np

from agents.batch import Batch
from agents.bridge import CriticMemories, common_critic_size, team_batch
from agents.devices.distributed import SINGLE_PROCESS, Communicator
from agents.learner import checkpoint
from agents.learner.happo import HappoLearner
from agents.rollout.rollout import Trajectory
from agents.settings import HAPPO, HappoConfig, SkillSettings
from arenas.arena import Arena
from arenas.arena_settings import Table
from arenas.games.terms import RewardTerms
from arenas.state import TeamSpec
from league.config.experiment import Config
from league.config.sections import named_players
from league.snapshots.transfer import warm_start
from league.snapshots.transfer.skills import TeamSkills, team_skills
from league.training.own_learner import LearnerSource, OwnLearner
from storage.records import Player, Snapshot
from storage.store import Store

AnyLearner = HappoLearner | OwnLearner


def settings_of(config: Config, player: Player) -> HappoConfig:
    """Return a player's settings: the league's, with the changes of its entry in `players`."""
    settings = config.learner
    for own in (entry for entry in named_players(config.players) if entry.name == player.name):
        if own.hidden is not None:
            settings = replace(settings, architecture=replace(settings.architecture, hidden=own.hidden))
        if own.lr is not None:
            settings = replace(settings, lr=own.lr)
        same = own.class_ in (None, settings.class_)
        given = Table({**(settings.settings if same else {}), **own.settings})
        settings = replace(settings, class_=own.class_ or settings.class_, settings=given)
        if own.flat:
            settings = replace(settings, skill=SkillSettings())
    return settings


def skills_of(config: Config, arena: Arena, player: Player) -> TeamSkills | None:
    """Return the skills through which a player's agents act, None if they act by themselves.

    Raises SkillError or StorageError for skills that cannot act in the arena.
    """
    return team_skills(settings_of(config, player).skill, arena, arena.teams[player.team])


def learning_team(config: Config, arena: Arena, player: Player) -> TeamSpec:
    """Return a player's team as its learner sees it: over skills, agents act with commands."""
    skills = skills_of(config, arena, player)
    return arena.teams[player.team] if skills is None else skills.team


def new_learner(
    config: Config,
    arena: Arena,
    player: Player,
    comm: Communicator = SINGLE_PROCESS,
    moved: Mapping[str, float] | None = None,
) -> AnyLearner:
    """Make a player's learner with its own seed and settings, and with the hyperparameters that have `moved`.

    Raises PlayerDiverged if it is of a class that cannot be found or made.
    """
    settings = replace(settings_of(config, player), **(moved or {}))
    seed = crc32(f"{config.seed}/{player.name}".encode())
    team = learning_team(config, arena, player)
    if settings.class_ != HAPPO:
        device = config.training.device
        return OwnLearner(player.name, LearnerSource(settings.class_, settings.settings, team, seed, device))
    if team is arena.teams[player.team]:
        settings = replace(settings, skill=SkillSettings())  # nobody in it has a skill: it learns each decision
    return _new_happo_learner(config, arena, player.team, team, settings, seed, comm)


def _new_happo_learner(
    config: Config, arena: Arena, number: int, team: TeamSpec, settings: HappoConfig, seed: int, comm: Communicator
) -> HappoLearner:
    agents = team.agents
    sizes = [a.observation_size for a in agents], [a.action_size for a in agents]
    other_sizes = [a.observation_size for other in others(config, arena, number) for a in other.agents]
    kinds, sees = [a.kind for a in agents], settings.critic_input
    critic_size = {"privileged": sum(sizes[0]) + arena.privileged_size, "same": common_critic_size(arena.teams)}.get(
        sees, 0
    )
    sets = [[each.places for each in a.entities] for a in agents]
    return HappoLearner(*sizes, settings, seed, config.training.device, kinds, other_sizes, critic_size, sets, comm)


def reset_learner(
    learner: AnyLearner, config: Config, arena: Arena, player: Player, store: Store, source: Snapshot, iteration: int,
    comm: Communicator = SINGLE_PROCESS,
) -> None:  # fmt: skip
    """Reset a player's learner to the actors of a snapshot and an otherwise initial state with a new random seed.

    The normalisation statistics of observations count as many decisions as the snapshot has learnt from. The first
    policy of a league that follows another one brings its statistics along, which keep their present count. A learner
    of another class becomes as new: `validate_learners` allows it no other reset.
    """
    fresh = new_learner(config, arena, player, comm)
    seed = crc32(f"{config.seed}/{player.name}/{iteration}".encode())
    if isinstance(learner, OwnLearner) or isinstance(fresh, OwnLearner):
        learner.load(fresh.save())
        learner.reseed(seed)
        return
    known = checkpoint.observed(learner.save())
    if not (source.initial and config.own_after.get(player.name, config.after)):
        known = {name: np.full_like(counts, source.step) for name, counts in known.items()}
    warm_start.thaw_into(fresh, store.blobs.get(source.digest), known)
    learner.load(fresh.save())
    learner.reseed(seed)


def batch_of(
    config: Config, arena: Arena, player: Player, trajectory: Trajectory, worlds: slice | np.ndarray = slice(None),
    shaping: float = 0.0, critic_memories: CriticMemories = (), skills: TeamSkills | None = None,
    gamma: float = 1.0, steps: int | None = None,
) -> Batch:  # fmt: skip
    """Return a player's part of a trajectory with the critic input that the settings choose; see `team_batch`.

    With `skills` it has a row for each of their commands, whose rewards are discounted by `gamma` per decision.
    """
    sees = config.learner.critic_input
    team, every = (arena.teams[player.team], 1) if skills is None else (skills.team, config.learner.skill.clock)
    return team_batch(
        trajectory, team, player.team, worlds, shaping, void_penalty(config),
        others=others(config, arena, player.team), privileged=sees == "privileged",
        common=arena.teams if sees == "same" else (), critic_memories=critic_memories, every=every, gamma=gamma,
        steps=steps,
    )  # fmt: skip


def void_penalty(config: Config) -> float:
    """Return what it costs a team to break the physics of its own robots: as much as the worst end of an episode."""
    reward = getattr(config.arena, "reward", None)  # settings of an arena of your own need not have one
    return reward.worst_ending if isinstance(reward, RewardTerms) else 1.0


def others(config: Config, arena: Arena, team: int) -> list[TeamSpec]:
    """Return the teams whose observations a team's critic sees beside its own."""
    return [t for i, t in enumerate(arena.teams) if i != team and config.learner.critic_input == "all"]
