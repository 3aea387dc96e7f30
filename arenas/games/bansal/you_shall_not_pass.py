"""You shall not pass: a runner must pass a line within the time, a blocker must keep it from there.

| term of the reward | when                                         | runner   | blocker                        |
|--------------------|----------------------------------------------|----------|--------------------------------|
| result             | the runner is over the line                  | +result  | -result                        |
|                    | the runner is down                           | -result  | +result if it stands, else 0   |
| result, timeout    | time is up                                   | -result  | timeout                        |
| shaping            | every control step                           | see `YouShallNotPassReward`               |

Events: `pass`, `down`.
"""

from typing import Any, Unpack

import jax.numpy as jnp
from jax import Array

from arenas.arena_settings import EngineOptions
from arenas.description import Legend, Part
from arenas.games.bansal.match import Contest, GameState
from arenas.games.bansal.rules import LINE, LINE_HALF
from arenas.games.bansal.run_to_goal import START, goal_line
from arenas.games.bansal.settings import YouShallNotPassSettings
from arenas.physics.engine import Physics
from arenas.state import Verdict

ROLE = jnp.array([[1.0], [-1.0]])  # runner, blocker
RUNNER = jnp.array([1.0, 0.0])
BOTH = jnp.array([1.0, -1.0])  # what the runner gains, the blocker loses


class YouShallNotPass(Contest):
    """You shall not pass; the runner has place 0."""

    def __init__(self, settings: YouShallNotPassSettings, **options: Unpack[EngineOptions]):
        super().__init__(settings, marker_kinds={"line": "segment"}, **options)
        self.rules = settings.rules

    def legend(self) -> Legend:
        """Describe the verdict; the notes of the weights describe the terms."""
        return Legend(
            score="1 for the runner if its base passes the line; 1 for the blocker if the runner is down first and it"
            " stands, or if time is up; ½ each if both are down",
            rewards=dict.fromkeys(("result", "timeout"), ""),
            shapings=dict.fromkeys(("forward", "distance", "control", "alive"), ""),
            events={"pass": "it runs, and has passed the line", "down": "its base is low"},
        )

    def draw(self, key: Array) -> tuple[Array, Any]:
        """Place the runner and the blocker on the x axis."""
        return jnp.array([[-START, 0.0], [START, 0.0]]), ()

    def extra_parts(self) -> tuple[Part, ...]:
        """Describe the role."""
        return (Part("role", 1, "", "1: runner, -1: blocker"),)

    def extra(self, physics: Physics, game: GameState) -> Array:
        """Return the roles."""
        return ROLE

    def judge(self, before: Physics, physics: Physics, game: GameState) -> tuple[GameState, Verdict]:
        """Judge the runner's place and both heights."""
        was, now = self.places(before, game), self.places(physics, game)
        ahead, down = now.xyz[0, 0], now.xyz[:, 2] <= self.rules.fall_height
        passed = ahead > LINE
        stopped = ~passed & down[0]
        late = self.late(physics) & ~passed & ~stopped
        blocked = stopped & ~down[1]  # by a blocker that stands
        lost = jnp.stack([stopped | late, passed])
        won = jnp.stack([passed, blocked])
        rewards = {
            "result": self.weights["result"] * (won * 1.0 - lost * 1.0),
            "timeout": self.weights["timeout"] * late * (1.0 - RUNNER),
        }
        shapings = {
            "forward": (ahead - was.xyz[0, 0]) * RUNNER,
            "distance": self.timing.control_interval * jnp.maximum(LINE - ahead, 0.0) * BOTH,
            **self.common_terms(game, now.xyz[:, 2]),
        }
        score = jnp.where(passed, RUNNER, jnp.where(blocked | late, 1.0 - RUNNER, 0.5))
        events = {"pass": jnp.stack([passed, jnp.zeros((), bool)]), "down": down}
        return game, self.verdict(game, rewards, shapings, score, passed | stopped | late, events)

    def markers(self, physics: Physics, game: GameState) -> dict[str, Array]:
        """Return the line."""
        return {"line": goal_line(LINE, LINE_HALF)}
