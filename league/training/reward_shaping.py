"""Annealing of reward shaping to zero, over environment steps or with success; then only the outcome is rewarded.

Bansal et al. (2018) anneal it over iterations. With success, shaping stays as long as it is needed: its weight is 1 up
to the chance score and falls linearly to 0 at `training.shaping_until`. The weight never rises again, because a player
that then loses more often would otherwise learn a different task.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from league.config.sections import Training

EPISODES = 1000  # over which the score is averaged: one team's score in an even game then stays within ½ ± 0.03
SCORE, WEIGHT = "shaping.score", "shaping.weight"  # in a player's checkpoint


def chance_score(teams: int) -> float:
    """Return the score that needs no skill: ½ against others, or 0 for a team alone."""
    return 0.5 if teams > 1 else 0.0


def by_steps(training: Training, steps: int) -> float:
    """Return the weight after `steps` environment steps: linear, from 1 to 0."""
    return max(0.0, 1.0 - steps / training.shaping_duration) if training.shaping_duration else 0.0


@dataclass
class SuccessAnnealing:
    """Shaping weight of one player, which falls with its running score over the worlds from which it learns."""

    chance_score: float
    until: float
    score: float = 0.0
    weight: float = 1.0

    def note(self, figures: Mapping[str, float]) -> None:
        """Update the weight with an iteration's `counted` episodes and mean `score`, see `agents.rollout.metrics`.

        The running score begins at the chance score, so that a few lucky first episodes change little.
        """
        if not figures["counted"]:
            return
        share = min(1.0, figures["counted"] / EPISODES)
        self.score += share * (figures["score"] - self.score)
        left = (self.until - self.score) / (self.until - self.chance_score)
        self.weight = max(0.0, min(self.weight, left))

    def follow(self, other: "SuccessAnnealing") -> None:
        """Continue from the score of another player, whose policy is taken over; the weight does not rise."""
        self.score, self.weight = other.score, min(self.weight, other.weight)

    def state(self) -> dict[str, np.ndarray]:
        """Return the entries of a checkpoint."""
        return {SCORE: np.array(self.score), WEIGHT: np.array(self.weight)}

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore from a checkpoint; start at the beginning if it was written without this setting."""
        if WEIGHT in state:
            self.score, self.weight = float(state[SCORE]), float(state[WEIGHT])
        else:
            self.score, self.weight = self.chance_score, 1.0


def make_annealing(training: Training, teams: int) -> SuccessAnnealing | None:
    """Make the annealing of a player at its start; None if shaping does not follow success."""
    if training.shaping_until is None:
        return None
    least = chance_score(teams)
    return SuccessAnnealing(least, training.shaping_until, least)
