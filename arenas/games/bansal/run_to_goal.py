"""Run to goal: two bodies face each other, and each must reach the line behind the other first.

| term of the reward | when                                                        | each                        |
|--------------------|-------------------------------------------------------------|-----------------------------|
| result             | a base is over its line / both in the same control step      | +result, -result / 0 and 0  |
| draw               | both have fallen, or time is up                              | draw                        |
| shaping            | every control step                                           | see `RunToGoalReward`       |

Events: `goal`, `fall`.
"""

from typing import Any, Unpack

import jax.numpy as jnp
from jax import Array

from arenas.arena_settings import EngineOptions
from arenas.description import Legend, Part
from arenas.games.bansal.match import Contest, GameState
from arenas.games.bansal.rules import LINE, LINE_HALF
from arenas.games.bansal.settings import RunToGoalSettings
from arenas.physics.engine import Physics
from arenas.state import Verdict

FORWARD = jnp.array([1.0, -1.0])  # of each place, along x
START = 1.0  # m from the middle


class RunToGoal(Contest):
    """Run to goal."""

    def __init__(self, settings: RunToGoalSettings, **options: Unpack[EngineOptions]):
        super().__init__(settings, marker_kinds={"left": "segment", "right": "segment"}, **options)
        self.rules = settings.rules

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        return Legend(
            score=f"1 for the first whose base is over the line {LINE + START:g} m ahead of its start, 0 for the other;"
            " ½ each if both are in one control step, if both have fallen, and when time is up",
            rewards=dict.fromkeys(("result", "draw"), ""),
            shapings=dict.fromkeys(("forward", "distance", "control", "alive"), ""),
            events={"goal": "it is over its line", "fall": "its base is low"},
        )

    def draw(self, key: Array) -> tuple[Array, Any]:
        """Place the bodies on the x axis."""
        return jnp.array([[-START, 0.0], [START, 0.0]]), ()

    def extra_parts(self) -> tuple[Part, ...]:
        """Describe no further numbers."""
        return ()

    def extra(self, physics: Physics, game: GameState) -> Array:
        """Return no further numbers."""
        return jnp.zeros((2, 0))

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Judge arrivals, falls and the end of the time."""
        was, now = self.places(before, game), self.places(physics, game)
        ahead, height = FORWARD * now.xyz[:, 0], now.xyz[:, 2]
        goal, fall = ahead > LINE, height <= self.rules.fall_height
        over = goal.any() | fall.all() | self.late(physics)
        won = goal & ~goal[::-1]
        rewards = {
            "result": self.weights["result"] * (won * 1.0 - won[::-1] * 1.0),
            "draw": jnp.full(2, self.weights["draw"]) * (over & ~goal.any()),
        }
        shapings = {
            "forward": ahead - FORWARD * was.xyz[:, 0],
            "distance": self.timing.control_interval * jnp.maximum(LINE - ahead, 0.0),
            **self.common_terms(game, height),
        }
        score = jnp.where(won.any(), won * 1.0, 0.5)
        return game, self.verdict(game, rewards, shapings, score, over, {"goal": goal, "fall": fall})

    def markers(self, physics: Physics, game: GameState) -> dict[str, Array]:
        """Return both lines."""
        return {"left": goal_line(-LINE, LINE_HALF), "right": goal_line(LINE, LINE_HALF)}


def goal_line(x: float, half: float) -> Array:
    """Return a line (6,) on the ground across the field, both ends."""
    return jnp.array([x, -half, 0.02, x, half, 0.02])
