"""Presets of skill below, strategy above (docs/skills.md): HARL-A's matches over policies that come with the league."""

from dataclasses import replace
from typing import Any

from agents.settings import Architecture, HappoConfig, SkillSettings
from league.config.experiment import Config, default
from league.config.sections import Budget


def soccer_2v2() -> Config:
    """Soccer of two ANYmals against two Leatherbacks, all of which can score alone; a strategy moves where they aim.

    A command is added to the goal that `anymal-score` and `leatherback-score` see, so that both begin as these are.
    """
    skill = SkillSettings(("anymal-score", "leatherback-score"), ("target goal:2",), reach=3.0)
    return _match("soccer-2v2", skill)


def sumo_by_team() -> Config:
    """Sumo of two ANYmals that can walk against two Leatherbacks that can do nothing yet; without the push stage."""
    return _match("sumo-by-team", WALK, reward=PUSH)


def sumo_within_team() -> Config:
    """Sumo of an ANYmal that can walk and a Leatherback that cannot yet drive in each team; without the push stage."""
    return _match("sumo-within-team", WALK, reward=PUSH)


WALK = SkillSettings(("anymal-walk",), ("slot A:2",), reach=3.0)
"""The goal of the walk is where an enemy is, and a command moves it: a command of zero walks into the enemy."""
PUSH = {"approach": 0.2, "push": 1.0}
"""Dense reward in place of the push stage."""


def _match(arena: str, skill: SkillSettings, **changes: Any) -> Config:
    """Return a league of one stage, for a GPU.

    The first commands are small beside their reach, and updates are small, so that nobody forgets the skill's play
    before the strategy is better.
    """
    config = default(arena)
    if reward := changes.get("reward"):
        config = replace(config, arena=replace(config.arena, reward=replace(config.arena.reward, **reward)))
    learner = HappoConfig(
        Architecture((128, 128), "elu"), skill=skill, lr=3e-4, critic_lr=1e-3, gamma=0.998, entropy_coef=0.001,
        desired_kl=0.01, initial_std=0.3, normalise_observations=True,
    )  # fmt: skip
    training = replace(config.training, rollout_length=64, shaping_steps=50_000_000, snapshots_per_doubling=4)
    budget = Budget(steps=200_000_000, rating_time="3m")
    return replace(config, league=f"{arena}-skills", learner=learner, training=training, budget=budget)
