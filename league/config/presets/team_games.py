"""Presets of games of many or unlike teams: tag, races through gates, a swarm."""

from dataclasses import replace
from typing import TYPE_CHECKING, cast

from agents.settings import Architecture, HappoConfig
from league.config.experiment import Config, default
from league.config.sections import Budget, PlayerSettings
from league.config.stages import Stage
from matchmaking.opponents import Opponents
from matchmaking.roles import Role

if TYPE_CHECKING:
    from arenas.games.race.settings import RaceSettings


def tag() -> Config:
    """Tag of three pucks, free for all: two minutes on two cores, then ratings.

    All are equally fast, so noise in the direction of a thrust decides games (docs/arenas/tag.md): the bonus for
    entropy is small, and steps follow the KL divergence.
    """
    config = default("tag")
    learner = replace(
        config.learner, gamma=0.99, entropy_coef=0.001, initial_std=0.4, desired_kl=0.01,
    )  # fmt: skip
    training = replace(config.training, shaping_steps=2_000_000)
    budget = Budget(training_time="2m", rating_time="1m")
    return replace(config, league="tag", learner=learner, training=training, budget=budget)


def swarm() -> Config:
    """Eight pucks that want to reach a zone, and two rovers that guard it: networks of sets, one for all pucks and one
    for both rovers, so that they can play in other numbers; for a GPU. Batches are small, since the game is slow. The
    swarm also meets earlier guards: against good ones alone it forgets what it could do.
    """
    config = default("swarm")
    learner = HappoConfig(
        Architecture((128, 128), entities=32), share_actors=True, lr=5e-4, critic_lr=1e-3, gamma=0.99,
        entropy_coef=0.001, initial_std=0.5, desired_kl=0.01,
    )  # fmt: skip
    training = replace(config.training, worlds=2048, shaping_steps=20_000_000, snapshots_per_doubling=2)
    budget = Budget(training_time="20m", rating_time="2m")
    players = (PlayerSettings("swarm", role="history"), PlayerSettings("guards"))
    roles = (Role("history", opponents=Opponents("uniform", past=0.5)),)
    return replace(
        config, league="swarm", players=players, roles=roles, learner=learner, training=training, budget=budget
    )


def gate_race() -> Config:
    """Two drones that race through gates: each learns to fly the track alone, then they race. For a GPU."""
    return _in_stages(gate_race_sparse(), "gate-race")


def gate_race_4() -> Config:
    """Four drones that race through gates, each a team of its own, and are ranked, by the same stages; for a GPU."""
    return _in_stages(_race("gate-race-4"), "gate-race-4")


def gate_race_sparse() -> Config:
    """Two drones that race through gates from nothing and are paid for places alone, as in 2512.11781; for a GPU.

    Its networks and batches are smaller than the paper's (512, 512, 256, 128; 10,240 worlds of 16 decisions). With
    `--arena.teams 1` a drone learns alone, and with `--arena.rules.walls true` there are walls.
    """
    return _race("gate-race")


def _in_stages(race: Config, league: str) -> Config:
    """Return the race as the second stage; in the first a drone learns alone, by the dense reward."""
    teams = cast("RaceSettings", race.arena).teams
    dense = {"progress": 1.0, "first": 0.0, "later": 0.0, "lap": 0.0}
    alone = {
        "arena": {"teams": 1, "room": teams - 1, "reward": dense},
        "training": {"shaping_steps": 10**12},  # the dense reward stays
        "budget": {"success": 0.9, "steps": 400_000_000},
    }  # fmt: skip
    racing = {
        "arena": {"reward": {"progress": 1.0}},
        # Against each other alone, drones get faster together and then lose to those that fly another way.
        "training": {"shaping_steps": 10**12, "opponents": {"kind": "uniform", "past": 0.5}},
        # A bonus for entropy lets deviations grow until drones hit the gates. Two seconds ahead, all that 0.99 sees, a
        # crash costs less than a gate passed first is worth.
        "learner": {"entropy_coef": 0.0, "gamma": 0.997},
        "budget": {"training_time": race.budget.training_time},
    }  # fmt: skip
    budget = replace(race.budget, training_time=None)  # one of the league would bound the first stage too
    return replace(race, league=league, budget=budget, stages=(Stage("alone", alone), Stage("race", racing)))


def _race(arena: str) -> Config:
    config = default(arena)
    learner = HappoConfig(
        Architecture((256, 256, 128), "elu"), lr=3e-4, critic_lr=5e-4, gamma=0.99, initial_std=0.5, desired_kl=0.01,
        normalise_observations=True,
    )  # fmt: skip
    training = replace(config.training, rollout_length=24, snapshots_per_doubling=2)
    budget = Budget(training_time="20m", rating_time="2m")
    return replace(config, league=arena, learner=learner, training=training, budget=budget)
