"""Learners of a team of three, two of which are equal robots."""

from dataclasses import replace

from agents.learner.happo import HappoLearner
from agents.settings import Architecture, HappoConfig

PLAIN = HappoConfig(
    Architecture((5,)), lr=0.02, critic_lr=0.05, gamma=0.0, epochs=2, minibatches=1, max_grad_norm=0.5,
    fixed_order=True, value_norm=False,
)  # fmt: skip
FULL = replace(PLAIN, gamma=0.97, minibatches=3, value_norm=True, normalise_observations=True, fixed_order=False)
EQUAL = {"observation_sizes": [4, 4, 3], "action_sizes": [2, 2, 1]}  # two equal robots and another


def new_learner(config: HappoConfig, seed: int = 0, **where) -> HappoLearner:
    """Of such a team."""
    return HappoLearner(**EQUAL, config=config, seed=seed, **where)
