"""Presets of games of turns and hidden information, whose newest policy a magnet holds near an equilibrium.

Their settings are those with the lowest exact exploitability in docs/results.md. `league exploitability GAME --policy
blue` computes it for the newest policy.
"""

from dataclasses import replace

from agents.settings import HappoConfig
from league.config.experiment import Config, default
from league.config.sections import Budget


def kuhn_poker() -> Config:
    """Kuhn poker against the newest opponents with a magnet (Sokota et al. 2023) that moves every 20 updates: half a
    minute on a CPU.
    """
    return _poker("kuhn-poker", magnet=0.2, updates=20, worlds=256, steps=120_000)


def leduc_poker() -> Config:
    """Leduc poker against the newest opponents with a fixed magnet, weaker as the game is larger; two minutes."""
    return _poker("leduc-poker", magnet=0.05, updates=0, worlds=512, steps=2_000_000)


def _poker(game: str, magnet: float, updates: int, worlds: int, steps: int) -> Config:
    """Return a league of a game whose return is paid at its end, undiscounted, with a critic that sees both hands."""
    config = default(game)
    learner = HappoConfig(
        lr=1e-3, critic_lr=1e-3, gamma=1.0, critic_input="privileged", magnet_coef=magnet, magnet_updates=updates
    )
    training = replace(config.training, worlds=worlds, rollout_length=16)
    budget = Budget(steps=steps, rating_time="30s")
    return replace(config, league=game, learner=learner, training=training, budget=budget)
