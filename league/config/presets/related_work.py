"""Presets of games of related work, each for a GPU: contests of Bansal et al., RARL's adversaries."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from agents.settings import Architecture, HappoConfig
from league.config.experiment import Config, default
from league.config.sections import Budget, PlayerSettings
from league.config.stages import Stage
from matchmaking.opponents import Opponents
from matchmaking.roles import Role
from matchmaking.schedule import Schedule

if TYPE_CHECKING:
    from arenas.games.disturbance import DisturbanceSettings

ANTS: Mapping[str, Any] = {"lr": 1e-3, "desired_kl": None}


def hopper_alone() -> Config:
    """Hopper that learns to hop ahead undisturbed, the base line of the next two; for a GPU."""
    return _hopper("hopper-alone", bodies=())


def hopper_adversary() -> Config:
    """Hopper against one adversary that pushes its foot (RARL, Pinto et al. 2017): both learn, by turns."""
    config = _hopper("hopper-adversary")
    training = replace(config.training, schedule=Schedule("leapfrog", period=25))
    budget = replace(config.budget, steps=200_000_000)  # of both in turn, so the walker has as many as in the others
    return replace(config, training=training, budget=budget)


def hopper_adversaries() -> Config:
    """Hopper against the history of four adversaries (Vinitsky et al. 2020): one learns beside it, three against its
    newest snapshot.
    """
    config = _hopper("hopper-adversaries")
    natures = [PlayerSettings("nature", f"nature-{i}" if i > 1 else "nature", "adversary") for i in range(1, 5)]
    roles = (
        Role("main", timeout=2_000_000, opponents=Opponents("delta_uniform", delta=0.5, past=0.75)),
        Role("adversary", timeout=2_000_000, opponents=Opponents("latest")),
    )
    return replace(config, players=(PlayerSettings("blue"), *natures), roles=roles)


def _hopper(name: str, **arena: Any) -> Config:
    """Return a league of a hopper against forces on its foot of at most a fifth of its weight; the walker's budget is
    the same in all.
    """
    config = default("disturbance")
    settings = cast("DisturbanceSettings", config.arena)
    rules = replace(settings.rules, weight_share=0.2)
    settings = replace(settings, **{"blue": ("hopper",), "bodies": ("foot",), "rules": rules, **arena})
    learner = HappoConfig(
        Architecture((128, 128), "elu"), lr=5e-4, critic_lr=1e-3, gamma=0.99, initial_std=0.5, desired_kl=0.01,
        normalise_observations=True,
    )  # fmt: skip
    training = replace(config.training, rollout_length=24, snapshots_per_doubling=2)
    budget = Budget(steps=100_000_000, rating_time="2m")
    return replace(config, league=name, arena=settings, learner=learner, training=training, budget=budget)


def run_to_goal() -> Config:
    """Ants that must reach the line behind the other first (Bansal et al. 2018); for a GPU."""
    return _contest("run-to-goal", 200_000_000, 0.99, **ANTS)


def sumo_ants() -> Config:
    """Ants that push each other over or out of a ring (Bansal et al. 2018); for a GPU."""
    return _contest("sumo-ants", 400_000_000, **ANTS)


def sumo_humanoids() -> Config:
    """Humanoids that push each other over or out of a ring (Bansal et al. 2018); for a GPU."""
    return _contest("sumo-humanoids", 800_000_000)


def you_shall_not_pass() -> Config:
    """Humanoids of which one runs to a line and the other blocks, in both roles (Bansal et al. 2018); for a GPU."""
    return _contest("you-shall-not-pass", 800_000_000)


def kick_and_defend() -> Config:
    """Humanoids of which one kicks a ball at a goal and the other keeps it, in both roles (Bansal et al. 2018); for a
    GPU. A humanoid first learns to walk to a point; then, with the ball in the point's place, to kick it past a keeper
    that never learns; then both play in both roles.
    """
    walk = {
        "arena": {"name": "walk", "blue": ["humanoid"], "rules": {"goal": 10.0}},
        "learner": {"lr": 1e-3, "gamma": 0.99, "entropy_coef": 0.005, "initial_std": 0.6},
        "training": {"worlds": 2048, "shaping_steps": 50_000_000, "opponents": {"kind": "latest", "delta": 0.0}},
        "budget": {"success": 0.9, "steps": 200_000_000},
    }  # fmt: skip
    kick = {
        "arena": {
            # From the middle of the ranges of the starts, from where the walker kicks goals, to all of them.
            "rules": {"roles": "fixed", "least_spread": 0.0, "box": 4.0},
            "reward": {"approach": -0.3, "ball": -1.0, "alive": 0.2},
        },
        "after_parts": ["*", "goal=ball"],
        "players": [{"team": "kicker"}, {"team": "keeper", "role": "fixed", "after": []}],
        "training": {"shaping_steps": 10**12},  # these rewards stay
        "budget": {"steps": 100_000_000},
    }
    stages = (Stage("walk", walk), Stage("kick", kick), Stage("full", {}))
    return replace(_contest("kick-and-defend", 800_000_000), stages=stages)


def _contest(
    arena: str, steps: int, gamma: float = 0.995, lr: float = 3e-4, desired_kl: float | None = 0.01
) -> Config:  # fmt: skip
    """Return a league in one of Bansal et al.'s games: dense terms fade over a quarter of `steps`, and opponents are
    the newer half of the history, their best rule for humanoids.
    """
    config = default(arena)
    learner = HappoConfig(
        Architecture((128, 128, 128), "elu"), lr=lr, critic_lr=1e-3, gamma=gamma, entropy_coef=0.0, initial_std=0.5,
        desired_kl=desired_kl, normalise_observations=True,
    )  # fmt: skip
    training = replace(
        config.training, rollout_length=24, shaping_steps=steps // 4, snapshots_per_doubling=4,
        opponents=Opponents("delta_uniform", delta=0.5),
    )  # fmt: skip
    return replace(
        config, league=arena, learner=learner, training=training, budget=Budget(steps=steps, rating_time="5m")
    )
