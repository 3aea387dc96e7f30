"""How the dense reward fades to none: over environment steps, or with success. After that the outcome alone is learnt.

Bansal et al. (2018) let it fade with the iterations. By success it stays for as long as it is needed: its weight is 1
up to the score that is had for nothing, and falls linearly to 0 at `training.shaping_until`. It never rises again, for
a player that then loses more would else be taught another game.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from league.config.sections import Training

EPISODES = 1000  # over which the score is averaged: one team's score in an even game then stays within ½ ± 0.03
SCORE, WEIGHT = "shaping.score", "shaping.weight"  # in a player's checkpoint


def floor(teams: int) -> float:
    """The score that is had for nothing: an even share, or no success where a team is alone."""
    return 1 / teams if teams > 1 else 0.0


def by_steps(training: Training, steps: int) -> float:
    """The weight after so many environment steps: linear, from 1 to 0."""
    return max(0.0, 1.0 - steps / training.fade_steps) if training.fade_steps else 0.0


@dataclass
class BySuccess:
    """The weight of one player, which falls with its running score over the worlds from which it learns."""

    floor: float
    until: float
    score: float = 0.0
    weight: float = 1.0

    def note(self, figures: Mapping[str, float]) -> None:
        """Take an iteration's `episodes` and their mean `score` into account, as `agents.rollout.outcomes` tells them.

        The running score begins at the floor, so that a few lucky first episodes change little.
        """
        if not figures["episodes"]:
            return
        share = min(1.0, figures["episodes"] / EPISODES)
        self.score += share * (figures["score"] - self.score)
        left = (self.until - self.score) / (self.until - self.floor)
        self.weight = max(0.0, min(self.weight, left))

    def follow(self, other: "BySuccess") -> None:
        """Go on from where another player stands, whose policy is taken over; the weight does not rise by that."""
        self.score, self.weight = other.score, min(self.weight, other.weight)

    def state(self) -> dict[str, np.ndarray]:
        """What a checkpoint keeps of it."""
        return {SCORE: np.array(self.score), WEIGHT: np.array(self.weight)}

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a checkpoint; from one written without this setting it begins anew."""
        if WEIGHT in state:
            self.score, self.weight = float(state[SCORE]), float(state[WEIGHT])
        else:
            self.score, self.weight = self.floor, 1.0


def begun(training: Training, teams: int) -> BySuccess | None:
    """A player's weight at its start, where it follows success; else None."""
    if training.shaping_until is None:
        return None
    least = floor(teams)
    return BySuccess(least, training.shaping_until, least)
